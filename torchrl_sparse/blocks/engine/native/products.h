// The matrix products of a query, with the rounding of activations that the type of the weights asks for, and LayerNorm.
// Writes to its result, b.rounded and b.grid; LayerNorm to b.y.
// Part of level.h, once for each instruction set: may call only what level.h includes before it.

inline void Query::product(const float* x, int ldx, int n, const Matrix& a, Range columns, float* y, int ldy) const {
    if (a.type == F32) return multiply<float>(x, ldx, n, a, columns, y, ldy);
    if (a.type == F16) return multiply<half>(x, ldx, n, a, columns, y, ldy);
    if (a.type == I8) return integer_product(x, ldx, n, a, columns, y, ldy);
    const int ld_rounded = b.ldh / 2;
    for (int t = 0; t < n; t++) round(x + t * ldx, 2 * a.rows, b.rounded + t * ld_rounded);
    multiply<Pair>(b.rounded, ld_rounded, n, a, columns, y, ldy);
}

inline void Query::whole_product(const float* x, int ldx, int n, const Matrix& a, float* y, int ldy) const {
    product(x, ldx, n, a, {0, a.columns}, y, ldy);
}

// f32 to BF16, to nearest even. `x` is padded to whole vectors.
inline void Query::round(const float* x, int n, float* pairs) {
    for (int j = 0; j < n; j += VECTOR) {
        const I bits = (I)load(x + j);
        *(UnalignedHalf*)((half*)pairs + j) = __builtin_convertvector((bits + 0x7fff + (bits >> 16 & 1)) >> 16, H);
    }
}

// x = step * (q - zero) in each row, with q in a byte, so that x * weight = step * scale * (q * w - zero * sum of w): the
// sums are exact, whatever their order. Those of up to 2^15 inputs fit into i32.
inline void Query::integer_product(const float* x, int ldx, int n, const Matrix& a, Range columns, float* y, int ldy) const {
    const int ld_rounded = b.ldh / 4;
    for (int t = 0; t < n; t++) {
        quantise(x + t * ldx, 4 * a.rows, (uint8_t*)(b.rounded + t * ld_rounded), b.grid + 2 * t);
        for (int j = columns.first; j < columns.last; j += VECTOR)
            *(UnalignedInts*)(y + t * ldy + j) = *(const UnalignedInts*)(a.sums + j) * -(int32_t)b.grid[2 * t + 1];
    }
    Matrix from = a;
    from.bias = y;
    from.bias_stride = ldy;
    multiply<Quad>(b.rounded, ld_rounded, n, from, columns, y, ldy);
    for (int t = 0; t < n; t++)
        for (int j = columns.first; j < columns.last; j += VECTOR) {
            const V total = __builtin_convertvector(*(const UnalignedInts*)(y + t * ldy + j), V);
            store(y + t * ldy + j, total * (load(a.scale + j) * b.grid[2 * t]) + load(a.bias + j));
        }
}

// A row of f32 to 256 levels, of which one is 0, from its least to its largest number. `x` is padded to whole vectors.
inline void Query::quantise(const float* x, int n, uint8_t* bytes, float* grid) {
    V below[2]{}, above[2]{};  // of every other vector: a comparison need not wait for the one before
    for (int j = 0; j < n; j += 2 * VECTOR)
        for (int i = 0; i < 2; i++) {
            const V v = load(x + (j + i * VECTOR < n ? j + i * VECTOR : j));
            below[i] = lesser(v, below[i]);
            above[i] = greater(v, above[i]);
        }
    const float low = least(lesser(below[0], below[1])), high = greatest(greater(above[0], above[1]));
    const float step = (high - low) / 255, inverse = step > 0 ? 1 / step : 0;
    const float zero = (float)(int32_t)(.5f - low * inverse);
    for (int j = 0; j < n; j += VECTOR) {
        V level = load(x + j) * inverse + (zero + .5f);
        level = level > 0.f ? level : V{};  // and if it is no number
        level = level < 255.f ? level : splat(255.f);
        *(UnalignedBytes*)(bytes + j) = __builtin_convertvector(__builtin_convertvector(level, I), B);
    }
    grid[0] = step;
    grid[1] = zero;
}

// y = (x - mean) / std of rows; gain and shift are in the weights that follow.
inline void Query::normalise(Range rows) const {
    for (int t = rows.first; t < rows.last; t++) {
        const float* const x = b.x + t * b.ld;
        float* const y = b.y + t * b.ld;
        V total{}, squares{};
        for (int j = 0; j < b.width; j += VECTOR) total += load(x + j);
        const float mean = sum(total) / m.width;
        for (int j = 0; j < b.width; j += VECTOR) {
            const V centred = (load(x + j) - mean) * load(m.valid + j);
            squares += centred * centred;
            store(y + j, centred);
        }
        const float scale = 1.f / __builtin_sqrtf(sum(squares) / m.width + 1e-5f);
        for (int j = 0; j < b.width; j += VECTOR) store(y + j, load(y + j) * scale);
    }
}
