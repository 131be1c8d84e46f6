// Matrix products of f32, f16, BF16 and 8-bit weights, in panels that lie as arena.py packs them. Writes only to its result.
// Part of level.h, once for each instruction set: may call only what level.h includes before it.

// y[row] = start[row] + x[row] * panel, for MR rows and the 32 columns of a panel, in strips of as many vectors as there are
// registers for. The processor does not fetch fast enough by itself what comes next: panels lie one behind the other.
template <int MR, class T>
void tile(const float* input, ptrdiff_t ldx, const T* panel, int rows, const float* start, ptrdiff_t ld_start, float* y,
          ptrdiff_t ldy) {
    constexpr int N = 2 * MR + 3 <= REGISTERS ? 2 : 1, AHEAD = 1280 / MR;
    for (int strip = 0; strip < PANEL; strip += N * VECTOR) {
        const float* x = input;
        const T* w = panel + strip;
        typename Sums<T>::type sums[MR][N];
        V weights[N];
#pragma GCC unroll 16
        for (int m = 0; m < MR; m++)
            for (int n = 0; n < N; n++) sums[m][n] = (typename Sums<T>::type)load(start + m * ld_start + strip + n * VECTOR);
        for (int k = 0; k < rows; k++, w += PANEL, x++) {
            for (int n = 0; n < N; n++) {
                __builtin_prefetch(w + AHEAD * PANEL + n * VECTOR, 0, 2);
                weights[n] = load(w + n * VECTOR);
            }
#pragma GCC unroll 16
            for (int m = 0; m < MR; m++) {
                const V f = splat(x[m * ldx]);
                for (int n = 0; n < N; n++) sums[m][n] = accumulate(sums[m][n], weights[n], f, w);
            }
        }
#pragma GCC unroll 16
        for (int m = 0; m < MR; m++)
            for (int n = 0; n < N; n++) store(y + m * ldy + strip + n * VECTOR, (V)sums[m][n]);
    }
}

template <int MR, class T>
INLINE void tiles(int count, const float* x, int ldx, const T* w, int rows, const float* b, int ldb, float* y, int ldy) {
    if constexpr (MR > 0) {
        if (count == MR) return tile<MR>(x, ldx, w, rows, b, ldb, y, ldy);
        tiles<MR - 1>(count, x, ldx, w, rows, b, ldb, y, ldy);
    }
}

// From `first` up to `last`: what is one thread's of so many items.
struct Range { int first, last; };

// y [n, columns] = x [n, rows] * weight + bias, in a range of columns that are whole panels.
template <class T>
void multiply(const float* x, int ldx, int n, const Matrix& a, Range columns, float* y, int ldy) {
    const int groups = (n + MAX_ROWS - 1) / MAX_ROWS;
    Tiles own;
    for (int k = 0; k < a.rows; k += PART) {
        const int depth = a.rows - k < PART ? a.rows - k : PART;
        const T* w = (const T*)a.weight + (size_t)k * a.columns + (size_t)columns.first * depth;
        const float* const start = k ? y : a.bias;  // y holds the sums so far
        const int ld_start = k ? ldy : a.bias_stride;
        for (int c = columns.first; c < columns.last; c += PANEL, w += (size_t)depth * PANEL)
            for (int g = 0; g < groups; g++) {
                const int m = n * g / groups, count = n * (g + 1) / groups - m;
                if (in_tiles(own, count, x + m * ldx + k, ldx, w, depth, start + m * ld_start + c, ld_start, y + m * ldy + c, ldy))
                    continue;
                tiles<MAX_ROWS>(count, x + m * ldx + k, ldx, w, depth, start + m * ld_start + c, ld_start,
                                y + m * ldy + c, ldy);
            }
    }
}

INLINE float dot(const float* a, const float* c, int n) {
    V total{};
    for (int j = 0; j < n; j += VECTOR) total += load(a + j) * load(c + j);
    return sum(total);
}
