// The denoising loop of one query of a Diffusion Policy transformer, for one CPU thread: plain C++17, no dependency.
//
// Python (native.py) folds and packs the weights once, and calls `sparse_denoise` through ctypes once for every action chunk.
// What is computed here, and why it is exact, is in native.py; this file is about doing it at the speed of the machine.
//
// * With 5 to 16 rows of activations, a matrix product is limited by the multiply-adds only if each weight is loaded once.
//   Weights are therefore packed in panels of 32 columns, [panel][input][32], which a tile of all rows x 32 columns reads
//   front to back while its sums stay in registers.
// * Nothing is allocated and nothing is shared: all memory of a call is `scratch`, so that any number of threads may call.
// * Every buffer row is padded to whole vectors and the padding of weights is zero, so that no loop has a remainder.
// * The kernels are written once, with the vector types of GCC and Clang, and compiled for three instruction sets by
//   including this file in itself. The caller chooses one at run time.

#ifndef VECTOR  // ---------------------------------------------------------------------- what is compiled only once

#include <cstddef>
#include <cstdint>
#if defined(__x86_64__)
#include <immintrin.h>
#endif

extern "C" {

// A packed matrix: panels of 32 columns, f32 or (weights of the trunk, if asked for) f16.
struct Matrix {
    const void* weight;  // [columns / 32][rows][32]
    const float* bias;   // [columns], or one row of it for each row of the result
    int32_t rows, columns;
};

struct Layer {
    Matrix qkv, out, up, down;  // LayerNorm's gain and shift and 1/sqrt(head size) are folded in
    Matrix kv;                  // cross-attention: memory token -> its keys and values
    const void* fold_q;         // [heads] matrices [head size, width]: key -> what it weighs normalised activations with
    const void* fold_o;         // [heads] matrices [head size, width]: value -> what it adds to the output
    const float* query_bias;    // [heads * padded head size]
    const float* cross_bias;    // [padded width]
};

struct Model {
    int32_t horizon, width, layers, heads, obs_steps, action_dim, cond_dim, steps;
    int32_t causal, half;  // half: weights of the trunk are f16
    float clip;
    const Layer* layer;
    Matrix embed, head;                // embed.bias is [horizon][padded width]: it holds the positions
    Matrix cond, encode_up, encode_down;  // the condition encoder; cond.bias is [obs_steps][padded width]
    const float* time_key;             // [steps][layers][heads][padded width], the folded keys of the time tokens
    const float* time_value;           // likewise
    const float* time_bias;            // [steps][layers][heads]
    const float* coefficients;         // [steps][6], see coefficients.py
    const float* valid;                // [2 * padded width]: 1 for each column, 0 for the padding and all that follows
};

// What one query computes, see plan.py.
struct Program {
    const int32_t* ops;     // [n][3]
    const int32_t* starts;  // [steps + 1]
    int32_t slots;          // latest outputs kept: one for each block, 3 (one for each type), or 1
};
}

namespace {

enum Op { COMPUTE, REUSE, COLLAPSE };
enum Epilogue { STORE, GELU, MISH };
constexpr int PANEL = 32;
constexpr float UNSEEN = -1e30f;  // a score whose weight e^-87 is lost next to that of a score that is seen
constexpr int AHEAD = 128;  // rows of a panel between the weights that are fetched and those that are used
using half = uint16_t;

constexpr int padded(int n) { return (n + PANEL - 1) / PANEL * PANEL; }
// Rows are one cache line longer than needed: powers of two would put all rows of a column in one set of the cache.
constexpr int stride(int n) { return padded(n) + 16; }
constexpr int padded_head(const Model& m) { return (m.width / m.heads + 15) / 16 * 16; }

// The memory of one call, cut out of `scratch`. Sizes in floats; every part starts on a cache line.
struct Buffers {
    float *x, *y, *qkv, *mixed, *hidden, *eps, *sample, *constant, *latest;
    float *token, *obs_key, *obs_value, *obs_bias, *scores;
    size_t size;
    Buffers(const Model& m, int slots, float* at) {
        float* const begin = at;
        auto take = [&at](size_t n) { float* p = at; at += (n + 15) / 16 * 16; return p; };
        const int tokens = m.horizon > m.obs_steps ? m.horizon : m.obs_steps, inner = m.heads * padded_head(m);
        x = take(tokens * stride(m.width));
        y = take(tokens * stride(m.width));
        qkv = take(tokens * stride(3 * padded(inner)));
        mixed = take(tokens * stride(inner));
        hidden = take(tokens * stride(4 * m.width));
        eps = take(m.horizon * stride(m.action_dim));
        sample = take(m.horizon * stride(m.action_dim));
        constant = take(m.horizon * padded(m.width));
        latest = take((size_t)slots * m.horizon * stride(m.width));
        token = take(m.obs_steps * stride(m.width));
        const size_t folded = (size_t)m.layers * m.obs_steps * m.heads;
        obs_key = take(folded * padded(m.width));
        obs_value = take(folded * padded(m.width));
        obs_bias = take(folded);
        const int keys = m.horizon > m.obs_steps ? m.horizon : 1 + m.obs_steps;
        scores = take((size_t)keys * padded(m.horizon * m.heads));
        size = at - begin;
    }
};

}  // namespace

#define VECTOR 4
#define LEVEL portable
#define REGISTERS 16
#define MAX_ROWS 6
#include "native.cpp"
#undef VECTOR
#undef LEVEL
#undef REGISTERS
#undef MAX_ROWS

#if defined(__x86_64__)
#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx2,fma,f16c"))), apply_to = function)
#else
#pragma GCC push_options
#pragma GCC target("avx2,fma,f16c")
#endif
#define VECTOR 8
#define LEVEL avx2
#define REGISTERS 16
#define MAX_ROWS 6  // 6 rows x 2 vectors of sums, 2 of weights, 1 of activations: 15 of 16 registers
#include "native.cpp"
#undef VECTOR
#undef LEVEL
#undef REGISTERS
#undef MAX_ROWS
#if defined(__clang__)
#pragma clang attribute pop
#pragma clang attribute push(__attribute__((target("avx512f,avx2,fma,f16c"))), apply_to = function)
#else
#pragma GCC pop_options
#pragma GCC push_options
#pragma GCC target("avx512f,avx2,fma,f16c")
#endif
#define VECTOR 16
#define LEVEL avx512
#define REGISTERS 32
#define MAX_ROWS 16  // the longest published horizon: every weight is read once
#include "native.cpp"
#undef VECTOR
#undef LEVEL
#undef REGISTERS
#undef MAX_ROWS
#if defined(__clang__)
#pragma clang attribute pop
#else
#pragma GCC pop_options
#endif
#endif

extern "C" {

// Instruction sets that this CPU can run: 1 portable, 2 also AVX2, 3 also AVX-512.
int32_t sparse_levels() {
#if defined(__x86_64__)
    if (!__builtin_cpu_supports("avx2") || !__builtin_cpu_supports("fma")) return 1;
    return __builtin_cpu_supports("avx512f") ? 3 : 2;
#else
    return 1;
#endif
}

// Floats that a call needs as scratch, which must start on a cache line (64 bytes).
int64_t sparse_scratch(const Model* m, int32_t slots) { return (int64_t)Buffers(*m, slots, nullptr).size; }

// noise [steps][horizon][action_dim], cond [obs_steps][cond_dim] -> actions [horizon][action_dim].
void sparse_denoise(int32_t level, const Model* m, const Program* program, const float* noise, const float* cond,
                    float* actions, float* scratch) {
#if defined(__x86_64__)
    if (level == 3) return avx512::denoise(*m, *program, noise, cond, actions, scratch);
    if (level == 2) return avx2::denoise(*m, *program, noise, cond, actions, scratch);
#endif
    portable::denoise(*m, *program, noise, cond, actions, scratch);
}

// Seconds are measured by the caller: runs one block of `kind` (0 SA, 1 CA, 2 FFN) of every layer, `repeats` times.
void sparse_block(int32_t level, const Model* m, int32_t kind, int32_t repeats, float* scratch) {
#if defined(__x86_64__)
    if (level == 3) return avx512::run_blocks(*m, kind, repeats, scratch);
    if (level == 2) return avx2::run_blocks(*m, kind, repeats, scratch);
#endif
    portable::run_blocks(*m, kind, repeats, scratch);
}
}

#else  // -------------------------------------------------------------- compiled once for each instruction set
// No function of another header may be called here: the linker could keep the copy for the wrong instruction set.

namespace {
namespace LEVEL {

#define INLINE static inline __attribute__((always_inline))
typedef float V __attribute__((vector_size(4 * VECTOR)));
typedef int32_t I __attribute__((vector_size(4 * VECTOR)));
typedef float Unaligned __attribute__((vector_size(4 * VECTOR), aligned(4), may_alias));

INLINE V load(const float* p) { return *(const Unaligned*)p; }
INLINE void store(float* p, V v) { *(Unaligned*)p = v; }
INLINE V splat(float f) { return f - V{}; }  // not V{} + f, which is not f if f is -0 and so costs an addition

INLINE V load(const half* p) {
#if VECTOR == 16
    return _mm512_cvtph_ps(_mm256_loadu_si256((const __m256i*)p));
#elif VECTOR == 8
    return _mm256_cvtph_ps(_mm_loadu_si128((const __m128i*)p));
#else
    I bits;
    for (int i = 0; i < VECTOR; i++) bits[i] = p[i];
    // The exponents of f16 and f32 differ by 112; multiplying is right for subnormal numbers as well.
    V magnitude = (V)((bits & 0x7fff) << 13) * 0x1p112f;
    return (V)((I)magnitude | (bits & 0x8000) << 16);
#endif
}

INLINE float sum(V v) {
#if VECTOR == 16
    return _mm512_reduce_add_ps(v);
#else
    float total = 0;
    for (int i = 0; i < VECTOR; i++) total += v[i];
    return total;
#endif
}

// e^x for x <= 88, to 1e-7; at most e^-87 instead of anything smaller.
INLINE V exponential(V x) {
    x = x > -87.f ? x : splat(-87.f);
    const V shifted = x * 1.44269504f + 12582912.f;  // 1.5 * 2^23: rounds to an integer, kept in the lowest bits
    const V n = shifted - 12582912.f;
    const V r = (x - n * 0.693359375f) + n * 2.12194440e-4f;  // ln 2 in two parts
    V p = splat(1 / 5040.f);
    p = p * r + 1 / 720.f;
    p = p * r + 1 / 120.f;
    p = p * r + 1 / 24.f;
    p = p * r + 1 / 6.f;
    p = p * r + .5f;
    p = p * r + 1.f;
    p = p * r + 1.f;
    return p * (V)(((I)shifted - 0x4b400000 + 127) << 23);
}

// x * Phi(x), the exact ("erf") GELU. Phi(-t) = e^(-t^2/2) R(t), where R is a polynomial in 1 / (1 + t/4), fitted to 3e-9:
// the result is closer to the exact one than 0.5 x (1 + erf(x/sqrt 2)) in f32, which cancels for negative x.
INLINE V gelu(V x) {
    const V t = x < 0.f ? -x : x;
    const V s = 1.f / (1.f + .25f * t);
    V p = splat(-0.0891343507619017f);
    p = p * s + 0.32901832999352676f;
    p = p * s - 0.2403634955249936f;
    p = p * s + 0.25131202873702246f;
    p = p * s + 0.04349856146156995f;
    p = p * s + 0.1060035273473261f;
    p = p * s + 0.09966539603291726f;
    p = p * s * exponential(-.5f * t * t);
    return x * (x < 0.f ? p : 1.f - p);
}

// x * tanh(ln(1 + e^x)), written with e^x alone.
INLINE V mish(V x) {
    const V e = exponential(x < 20.f ? x : splat(20.f));
    const V n = e * (e + 2.f);
    return x * (n / (n + 2.f));
}

// y[row] = bias[row] + x[row] * panel, for MR rows and the 32 columns of a panel, in strips of as many vectors as there are
// registers for. The processor does not fetch fast enough by itself what comes next: panels lie one behind the other.
template <int MR, class T>
void tile(const float* input, ptrdiff_t ldx, const T* panel, int rows, const float* bias, ptrdiff_t ld_bias, float* y,
          ptrdiff_t ldy) {
    constexpr int N = 2 * MR + 3 <= REGISTERS ? 2 : 1;
    for (int strip = 0; strip < PANEL; strip += N * VECTOR) {
        const float* x = input;
        const T* w = panel + strip;
        V sums[MR][N], weights[N];
#pragma GCC unroll 16
        for (int m = 0; m < MR; m++)
            for (int n = 0; n < N; n++) sums[m][n] = load(bias + m * ld_bias + strip + n * VECTOR);
        for (int k = 0; k < rows; k++, w += PANEL, x++) {
            for (int n = 0; n < N; n++) {
                __builtin_prefetch(w + AHEAD * PANEL + n * VECTOR, 0, 2);
                weights[n] = load(w + n * VECTOR);
            }
#pragma GCC unroll 16
            for (int m = 0; m < MR; m++) {
                const V f = splat(x[m * ldx]);
                for (int n = 0; n < N; n++) sums[m][n] += weights[n] * f;
            }
        }
#pragma GCC unroll 16
        for (int m = 0; m < MR; m++)
            for (int n = 0; n < N; n++) store(y + m * ldy + strip + n * VECTOR, sums[m][n]);
    }
}

template <int MR, class T>
INLINE void tiles(int count, const float* x, int ldx, const T* w, int rows, const float* b, int ldb, float* y, int ldy) {
    if constexpr (MR > 0) {
        if (count == MR) return tile<MR>(x, ldx, w, rows, b, ldb, y, ldy);
        tiles<MR - 1>(count, x, ldx, w, rows, b, ldb, y, ldy);
    }
}

// y [n, columns] = epilogue(x [n, rows] * weight + bias); ld_bias 0 gives every row the same bias.
template <class T>
void multiply(const float* x, int ldx, int n, const T* w, int rows, int columns, const float* bias, int ld_bias, float* y,
              int ldy, Epilogue epilogue = STORE) {
    const int groups = (n + MAX_ROWS - 1) / MAX_ROWS;
    // Where the registers do not hold all rows, a panel is read more than once, and so in parts that stay in the L1 cache.
    const int part = VECTOR == 16 && groups == 1 ? rows : 128;
    for (int c = 0; c < columns; c += PANEL) {
        for (int k = 0; k < rows; k += part) {
            const int depth = rows - k < part ? rows - k : part;
            for (int g = 0; g < groups; g++) {
                const int m = n * g / groups, count = n * (g + 1) / groups - m;
                float* const out = y + m * ldy + c;  // holds the sum so far
                const float* start = k ? out : bias + m * ld_bias + c;
                tiles<MAX_ROWS>(count, x + m * ldx + k, ldx, w, depth, start, k ? ldy : ld_bias, out, ldy);
            }
            w += (size_t)depth * PANEL;
        }
        if (epilogue == STORE) continue;
        for (int m = 0; m < n; m++)
            for (int j = c; j < c + PANEL; j += VECTOR) {
                const V v = load(y + m * ldy + j);
                store(y + m * ldy + j, epilogue == GELU ? gelu(v) : mish(v));
            }
    }
}

// One query. `T` is the type of the trunk's weights.
template <class T>
struct Query {
    const Model& m;
    const Buffers b;
    // Strides: `width` of folded vectors, `ld` of activations, `head` and `inner` of one and of all padded heads.
    const int slots, width, ld, head, inner, lanes;

    Query(const Model& m, int slots, float* scratch)
        : m(m), b(m, slots, scratch), slots(slots), width(padded(m.width)), ld(stride(m.width)), head(padded_head(m)),
          inner(m.heads * head), lanes(padded(m.horizon * m.heads)) {}

    // Whether action t may not look at action s or, in the memory, at observation s (token s + 1).
    bool hidden(int s, int t) const { return m.causal && s > t; }

    void product(const float* x, int ldx, int n, const Matrix& a, float* y, int ldy, Epilogue e = STORE) const {
        multiply(x, ldx, n, (const T*)a.weight, a.rows, a.columns, a.bias, 0, y, ldy, e);
    }

    // y = (x - mean) / std of every row; gain and shift are in the weights that follow.
    void normalise(const float* x, float* y) const {
        for (int t = 0; t < m.horizon; t++, x += ld, y += ld) {
            V total{}, squares{};
            for (int j = 0; j < width; j += VECTOR) total += load(x + j);
            const float mean = sum(total) / m.width;
            for (int j = 0; j < width; j += VECTOR) {
                const V centred = (load(x + j) - mean) * load(m.valid + j);
                squares += centred * centred;
                store(y + j, centred);
            }
            const float scale = 1.f / __builtin_sqrtf(sum(squares) / m.width + 1e-5f);
            for (int j = 0; j < width; j += VECTOR) store(y + j, load(y + j) * scale);
        }
    }

    void add(float* x, const float* d) const {
        for (int t = 0; t < m.horizon; t++, x += ld, d += ld)
            for (int j = 0; j < width; j += VECTOR) store(x + j, load(x + j) + load(d + j));
    }

    // Scores lie as [key][lane], a lane being one head of one query: n keys are summed up without leaving the vector.
    float& score(int key, int t, int h) const { return b.scores[(size_t)key * lanes + t * m.heads + h]; }

    void softmax(int n) const {
        for (int lane = 0; lane < lanes; lane += VECTOR) {
            float* const s = b.scores + lane;
            V most = load(s), total{};
            for (int i = 1; i < n; i++) {
                const V v = load(s + (size_t)i * lanes);
                most = v > most ? v : most;
            }
            for (int i = 0; i < n; i++) {
                const V e = exponential(load(s + (size_t)i * lanes) - most);
                store(s + (size_t)i * lanes, e);
                total += e;
            }
            const V scale = 1.f / total;
            for (int i = 0; i < n; i++) store(s + (size_t)i * lanes, load(s + (size_t)i * lanes) * scale);
        }
    }

    INLINE float dot(const float* a, const float* c, int n) {
        V total{};
        for (int j = 0; j < n; j += VECTOR) total += load(a + j) * load(c + j);
        return sum(total);
    }

    void self_attention(const Layer& layer, float* d) const {
        normalise(b.x, b.y);
        const int part = padded(inner), ldq = stride(3 * part), ldm = stride(inner);
        product(b.y, ld, m.horizon, layer.qkv, b.qkv, ldq);
        const float *keys = b.qkv + part, *values = keys + part;
        for (int t = 0; t < m.horizon; t++)
            for (int h = 0; h < m.heads; h++)
                for (int s = 0; s < m.horizon; s++)
                    score(s, t, h) = hidden(s, t) ? UNSEEN : dot(b.qkv + t * ldq + h * head, keys + s * ldq + h * head, head);
        softmax(m.horizon);
        for (int t = 0; t < m.horizon; t++)
            for (int h = 0; h < m.heads; h++)
                for (int j = h * head; j < h * head + head; j += VECTOR) {
                    V total{};
                    for (int s = 0; s < m.horizon && !hidden(s, t); s++) total += load(values + s * ldq + j) * score(s, t, h);
                    store(b.mixed + t * ldm + j, total);
                }
        product(b.mixed, ldm, m.horizon, layer.out, d, ld);
    }

    // Scores and outputs are products with the folded memory: 1 + obs_steps vectors for each head and side.
    void cross_attention(int step, int index, float* d) const {
        normalise(b.x, b.y);
        const size_t time = ((size_t)step * m.layers + index) * m.heads, obs = (size_t)index * m.obs_steps * m.heads;
        const float *bias = m.layer[index].cross_bias, *time_value = m.time_value + time * width;
        const float *keys = b.obs_key + obs * width, *values = b.obs_value + obs * width;
        for (int t = 0; t < m.horizon; t++)
            for (int h = 0; h < m.heads; h++) {
                const float* y = b.y + t * ld;
                score(0, t, h) = dot(y, m.time_key + (time + h) * width, width) + m.time_bias[time + h];
                for (int o = 0; o < m.obs_steps; o++) {
                    const int i = o * m.heads + h;
                    score(1 + o, t, h) = hidden(o, t) ? UNSEEN : dot(y, keys + (size_t)i * width, width) + b.obs_bias[obs + i];
                }
            }
        softmax(1 + m.obs_steps);
        for (int t = 0; t < m.horizon; t++)
            for (int j = 0; j < width; j += VECTOR) {
                V total = load(bias + j);
                for (int h = 0; h < m.heads; h++) total += load(time_value + h * width + j) * score(0, t, h);
                for (int o = 0; o < m.obs_steps && !hidden(o, t); o++)
                    for (int h = 0; h < m.heads; h++)
                        total += load(values + (size_t)(o * m.heads + h) * width + j) * score(1 + o, t, h);
                store(d + t * ld + j, total);
            }
    }

    void feed_forward(const Layer& layer, float* d) const {
        normalise(b.x, b.y);
        const int ldh = stride(4 * m.width);
        product(b.y, ld, m.horizon, layer.up, b.hidden, ldh, GELU);
        product(b.hidden, ldh, m.horizon, layer.down, d, ld);
    }

    float* latest(int block) const { return b.latest + (size_t)(block % slots) * m.horizon * ld; }

    void compute(int step, int block) const {
        float* const d = latest(block);
        const int index = block / 3;
        if (block % 3 == 0) self_attention(m.layer[index], d);
        if (block % 3 == 1) cross_attention(step, index, d);
        if (block % 3 == 2) feed_forward(m.layer[index], d);
        add(b.x, d);
    }

    // to [horizon, width] = from + what the blocks first .. last-1 add, in one pass.
    void reuse(const float* from, int ld_from, float* to, int ld_to, int first, int last) const {
        const bool shared = slots < 3 * m.layers;  // a slot counts as often as its blocks occur
        const int begin = shared ? 0 : first, end = shared ? slots : last;
        for (int t = 0; t < m.horizon; t++)
            for (int j = 0; j < width; j += VECTOR) {
                V total = load(from + t * ld_from + j);
                for (int s = begin; s < end; s++) {
                    const int before = slots - 1 - s;
                    const float times = shared ? (last + before) / slots - (first + before) / slots : 1;
                    total += load(b.latest + ((size_t)s * m.horizon + t) * ld + j) * times;
                }
                store(to + t * ld_to + j, total);
            }
    }

    // Encodes the observations and folds them into the cross-attention of every layer.
    void encode(const float* cond) const {
        const int n = m.obs_steps, ldh = stride(4 * m.width), part = padded(inner), ldk = stride(2 * part);
        multiply(cond, m.cond_dim, n, (const float*)m.cond.weight, m.cond_dim, width, m.cond.bias, width, b.y, ld);
        product(b.y, ld, n, m.encode_up, b.hidden, ldh, MISH);
        product(b.hidden, ldh, n, m.encode_down, b.token, ld);
        const size_t matrix = (size_t)head * width;
        for (int i = 0; i < m.layers; i++) {
            const Layer& layer = m.layer[i];
            product(b.token, ld, n, layer.kv, b.qkv, ldk);
            for (int h = 0; h < m.heads; h++) {
                const size_t at = (size_t)i * n * m.heads + h;
                const float *key = b.qkv + h * head, *value = key + part;
                const T *fold_q = (const T*)layer.fold_q + h * matrix, *fold_o = (const T*)layer.fold_o + h * matrix;
                const int next = m.heads * width;
                float *keys = b.obs_key + at * width, *values = b.obs_value + at * width;
                multiply(key, ldk, n, fold_q, head, width, m.valid + width, 0, keys, next);
                multiply(value, ldk, n, fold_o, head, width, m.valid + width, 0, values, next);
                for (int o = 0; o < n; o++) b.obs_bias[at + o * m.heads] = dot(key + o * ldk, layer.query_bias + h * head, head);
            }
        }
    }

    // Predicts the noise from the residual stream and takes the scheduler's step.
    void advance(int step, const float* noise) const {
        normalise(b.x, b.y);
        const int lda = stride(m.action_dim);
        multiply(b.y, ld, m.horizon, (const float*)m.head.weight, m.width, m.head.columns, m.head.bias, 0, b.eps, lda);
        const float* c = m.coefficients + 6 * step;
        for (int t = 0; t < m.horizon; t++)
            for (int j = 0; j < m.action_dim; j++) {
                float& sample = b.sample[t * lda + j];
                const float eps = b.eps[t * lda + j];
                float clean = (sample - c[0] * eps) / c[1];
                clean = clean > m.clip ? m.clip : clean < -m.clip ? -m.clip : clean;
                const float next = c[2] * clean + c[3] * sample + c[4] * eps;
                sample = noise ? next + c[5] * noise[t * m.action_dim + j] : next;
            }
    }

    void run(const Program& program, const float* noise, const float* cond, float* actions) const {
        const int lda = stride(m.action_dim), size = m.horizon * m.action_dim;
        encode(cond);
        for (int i = 0; i < size; i++) b.sample[i / m.action_dim * lda + i % m.action_dim] = noise[i];
        for (int step = 0; step < m.steps; step++) {
            const int32_t* op = program.ops + 3 * program.starts[step];
            const int32_t* const end = program.ops + 3 * program.starts[step + 1];
            const bool collapsed = op[0] == COLLAPSE;
            if (collapsed && op[1]) reuse(m.embed.bias, width, b.constant, width, 0, 3 * m.layers);
            multiply(b.sample, lda, m.horizon, (const float*)m.embed.weight, m.action_dim, width,
                     collapsed ? b.constant : m.embed.bias, width, b.x, ld);
            for (; op < end; op += 3) {
                if (op[0] == COMPUTE) compute(step, op[1]);
                if (op[0] == REUSE) reuse(b.x, ld, b.x, ld, op[1], op[2]);
            }
            advance(step, step + 1 < m.steps ? noise + (size_t)(step + 1) * size : nullptr);
        }
        for (int i = 0; i < size; i++) actions[i] = b.sample[i / m.action_dim * lda + i % m.action_dim];
    }
};

void denoise(const Model& m, const Program& p, const float* noise, const float* cond, float* actions, float* scratch) {
    if (m.half) return Query<half>(m, p.slots, scratch).run(p, noise, cond, actions);
    Query<float>(m, p.slots, scratch).run(p, noise, cond, actions);
}

template <class T>
void run_blocks(const Query<T>& query, int kind, int repeats) {
    for (int i = 0; i < repeats; i++)
        for (int layer = 0; layer < query.m.layers; layer++) query.compute(0, 3 * layer + kind);
}

void run_blocks(const Model& m, int kind, int repeats, float* scratch) {
    if (m.half) return run_blocks(Query<half>(m, 3, scratch), kind, repeats);
    run_blocks(Query<float>(m, 3, scratch), kind, repeats);
}

#undef INLINE
}  // namespace LEVEL
}  // namespace
#endif
