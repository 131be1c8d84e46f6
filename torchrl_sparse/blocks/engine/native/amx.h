// Products in the tiles of AMX, where the instruction set has them (TILES).
// Part of level.h, once for each instruction set: may call only what level.h includes before it.

// What `tile` does, where the processor has tiles of its own for it; else false. (8 bits in such tiles were no faster.)
struct Tiles;
template <class T>
INLINE bool in_tiles(Tiles&, int, const float*, ptrdiff_t, const T*, int, const float*, ptrdiff_t, float*, ptrdiff_t) {
    return false;
}

#if defined(TILES)
constexpr int TILE = 16;  // rows, and pairs of BF16 in each

struct Shapes {
    uint8_t palette = 1, start = 0, reserved[14] = {};
    uint16_t bytes[16] = {};  // of a row
    uint8_t rows[16] = {};
};

struct Tiles {
    int rows = 0;  // of activations

    // Tiles 0 and 1 are sums, 2 are activations; 3 and 4 are weights.
    void shape(int count) {
        Shapes shapes;
        for (int i = 0; i < 5; i++) {
            shapes.bytes[i] = 4 * TILE;
            shapes.rows[i] = (uint8_t)(i < 3 ? count : TILE);
        }
        _tile_loadconfig(&shapes);
        rows = count;
    }
    ~Tiles() {
        if (rows) _tile_release();  // or each switch to another process would save them
    }
};

INLINE bool in_tiles(Tiles& tiles, int count, const float* x, ptrdiff_t ldx, const Pair* w, int rows, const float* start,
                     ptrdiff_t ld_start, float* y, ptrdiff_t ldy) {
    constexpr int AHEAD = 4 * TILE;
    if (rows % TILE) return false;
    if (tiles.rows != count) tiles.shape(count);
    _tile_loadd(0, start, 4 * ld_start);
    _tile_loadd(1, start + TILE, 4 * ld_start);
    for (int k = 0; k < rows; k += TILE, w += TILE * PANEL) {
        for (int i = 0; i < TILE * PANEL; i += TILE) __builtin_prefetch(w + AHEAD * PANEL + i, 0, 2);
        _tile_loadd(2, x + k, 4 * ldx);
        _tile_loadd(3, w, 4 * PANEL);
        _tile_loadd(4, w + TILE, 4 * PANEL);
        _tile_dpbf16ps(0, 2, 3);
        _tile_dpbf16ps(1, 2, 4);
    }
    _tile_stored(0, y, 4 * ldy);
    _tile_stored(1, y + TILE, 4 * ldy);
    return true;
}
#else
struct Tiles {};
#endif
