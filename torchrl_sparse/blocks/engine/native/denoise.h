// The denoising loop of one query of a Diffusion Policy transformer: plain C++17, no dependency.
//
// Python folds and packs the weights once. What is computed here, and why it is exact, is in folding.py and packing.py; this
// file is about doing it at the speed of the machine.
//
// * With 5 to 16 rows of activations, a matrix product is limited by the multiply-adds only if each weight is loaded once.
//   Weights are therefore packed in panels of 32 columns, which a tile of all rows x 32 columns reads front to back while
//   its sums stay in registers; and in parts of 256 inputs, of which all rows stay in the L1 cache for all panels.
// * A query may be shared by the threads of a team. All of them run the same loop; each keeps the residual stream and the
//   sample for itself, computes its panels of a product and its rows of an attention, and waits for the others where it
//   needs theirs: six or seven times in a layer, never in a step without a computed block. Every number comes from the same
//   sums in the same order whatever the number of threads.
// * Nothing is allocated: all memory of a query is its `scratch`, so that any number of queries may run at a time.
// * Every buffer row is padded to whole vectors and the padding of weights is zero, so that no loop has a remainder.
// * The kernels are written once, with the vector types of GCC and Clang, and compiled for up to five instruction sets by
//   including this file in itself. The caller chooses one of LEVELS at run time.

#ifndef VECTOR  // ---------------------------------------------------------------------- what is compiled only once

#include <cstddef>
#include <cstdint>
#if defined(PORTABLE_ONLY)  // for tests
#elif defined(__x86_64__)
#define X86
#include <immintrin.h>
#if defined(__linux__) && (defined(__clang__) || __GNUC__ >= 11)
#define X86_TILES
#include <cpuid.h>
#include <sys/syscall.h>
#include <unistd.h>
#endif
#elif defined(__aarch64__)
#define ARM
#include <arm_neon.h>
#endif

#include "member.h"

extern "C" {

enum Type : int32_t { F32, F16, BF16, I8 };

// A packed matrix [part][columns / 32][inputs of the part][32]. Of BF16, two inputs count as one, and of I8 four: they lie
// side by side.
struct Matrix {
    const void* weight;
    const float* bias;    // [columns], or one row of it for each row of the result
    const float* scale;   // of I8 [columns]: what a weight of 1 stands for
    const int32_t* sums;  // of I8 [columns]: of the weights
    int32_t rows, columns, bias_stride;
    Type type;
};

struct Layer {
    Matrix qkv, out, up, down;  // LayerNorm's gain and shift and 1/sqrt(head size) are folded in
    Matrix kv;                  // cross-attention: memory token -> its keys and values
    const Matrix* fold;         // [2][heads]: key -> what it weighs normalised activations with, value -> what it adds
    const float* query_bias;    // [heads * padded head size]
    const float* cross_bias;    // [padded width]
};

struct Model {
    int32_t horizon, width, layers, heads, obs_steps, action_dim, cond_dim, steps, causal;
    int32_t history;            // 0 unless the sampler reads earlier clean predictions
    float clip;
    const Layer* layer;
    Matrix embed, head, encode_up, encode_down;  // embed and encode_up have a bias for each row: it holds the positions
    const float* time_key;      // [steps][layers][heads][padded width], the folded keys of the time tokens
    const float* time_value;    // likewise
    const float* time_bias;     // [steps][layers][heads]
    const float* coefficients;  // [steps][8], see coefficients.py
    const float* valid;         // [padded width]: 1 for each column, 0 for the padding
};

// What the clean predictions of one query are drawn to; null where they are not.
struct Guide {
    const float* actions;  // [horizon][action_dim]
    const float* pull;     // [horizon], 0 to 1
};

// The MLP of a pruner, see pruner.py. A cell is a block of a denoising step.
struct Pruner {
    Matrix obs, middle;  // observation -> what it adds to every cell; cell -> its second hidden layer
    const float* cells;  // [count][padded width]: what a cell is without an observation
    const float* last;   // [padded width]
    float bias;          // of the last layer
    int32_t count;       // of cells
    int32_t first;       // cells of the first step, which is never pruned
};
}

namespace {

enum Activation { GELU, MISH };
constexpr int PANEL = 32, PART = 256;
constexpr int MAX_HIDDEN = 256;   // of a pruner
constexpr float UNSEEN = -1e30f;  // a score whose weight e^-87 is lost next to that of a score that is seen
using half = uint16_t;
struct Pair { uint16_t first, second; };  // of BF16
struct Quad { int8_t weights[4]; };       // of I8; the activations that belong to it are unsigned

constexpr int padded(int n) { return (n + PANEL - 1) / PANEL * PANEL; }
// Rows are one cache line longer than needed: powers of two would put all rows of a column in one set of the cache.
constexpr int stride(int n) { return padded(n) + 16; }

// The memory of one query, and its strides. Sizes in floats; every part starts on a cache line. Each thread has a piece of
// `size`: all use the parts of `shared` in the first thread's piece, and of `own` in theirs.
struct Buffers {
    // Of folded vectors, of activations, of one and of all padded heads, of hidden activations, of scores.
    const int width, ld, head, inner, ldh, lanes;
    float *x, *y, *kv, *rounded, *eps, *sample, *constant, *scores;  // own
    float* cleans;  // own [2][horizon]: the clean predictions of the step before and of the one before it
    float* grid;    // own [horizon][2]: the step and the zero of rows that are rounded to I8
    float *qkv, *mixed, *hidden, *latest, *token;  // shared
    float *key, *value, *key_bias;  // shared [layers][obs_steps][heads]: what cross-attention reads of the observations
    size_t size;
    Buffers(const Model& m, int slots, float* own, float* shared)
        : width(padded(m.width)), ld(stride(m.width)), head((m.width / m.heads + 15) / 16 * 16), inner(m.heads * head),
          ldh(stride(4 * m.width)), lanes(padded(m.horizon * m.heads)) {
        size = 0;
        auto take = [this](float* base, size_t n) { float* p = base + size; size += (n + 15) / 16 * 16; return p; };
        const int tokens = m.horizon > m.obs_steps ? m.horizon : m.obs_steps, memory = 1 + m.obs_steps;
        x = take(own, m.horizon * ld);
        y = take(own, m.horizon * ld);
        kv = take(own, m.obs_steps * stride(2 * padded(inner)));
        rounded = take(own, tokens * ldh);
        eps = take(own, m.horizon * stride(m.action_dim));
        sample = take(own, m.horizon * stride(m.action_dim));
        cleans = take(own, 2 * m.horizon * stride(m.action_dim));
        grid = take(own, 2 * m.horizon);
        constant = take(own, m.horizon * width);
        scores = take(own, (size_t)(m.horizon > memory ? m.horizon : memory) * lanes);
        qkv = take(shared, m.horizon * stride(3 * padded(inner)));
        mixed = take(shared, m.horizon * stride(inner));
        hidden = take(shared, tokens * ldh);
        latest = take(shared, (size_t)slots * m.horizon * ld);
        token = take(shared, m.obs_steps * ld);
        const size_t folded = (size_t)m.layers * m.obs_steps * m.heads;
        key = take(shared, folded * width);
        value = take(shared, folded * width);
        key_bias = take(shared, folded);
    }
};

}  // namespace

#define EXPANDED(text) _Pragma(#text)
#define PRAGMA(text) EXPANDED(text)

#define LEVEL portable
#define VECTOR 4
#include "denoise.h"
#if defined(ARM)  // always has NEON: the portable vectors are its own, and there are twice as many registers
#define LEVEL neon
#define VECTOR 4
#define NEON
#include "denoise.h"
#elif defined(X86)
#define LEVEL avx2
#define VECTOR 8
#define TARGET "avx2,fma,f16c"
#include "denoise.h"
#define LEVEL avx512
#define VECTOR 16
#define TARGET "avx512f,avx2,fma,f16c"
#include "denoise.h"
#define LEVEL avx512_bf16
#define VECTOR 16
#define TARGET "avx512bf16,avx512vnni,avx512f,avx2,fma,f16c"
#define DOTS
#include "denoise.h"
#if defined(X86_TILES)
#define LEVEL amx
#define VECTOR 16
#define TARGET "amx-tile,amx-bf16,avx512bf16,avx512vnni,avx512f,avx2,fma,f16c"
#define DOTS
#define TILES
#include "denoise.h"
#endif
#endif

namespace {
struct Level {
    decltype(&portable::denoise) denoise;
    decltype(&portable::run_blocks) run_blocks;
    decltype(&portable::prune) prune;
};
const Level LEVELS[] = {
    {portable::denoise, portable::run_blocks, portable::prune},
#if defined(ARM)
    {neon::denoise, neon::run_blocks, neon::prune},
#elif defined(X86)
    {avx2::denoise, avx2::run_blocks, avx2::prune},
    {avx512::denoise, avx512::run_blocks, avx512::prune},
    {avx512_bf16::denoise, avx512_bf16::run_blocks, avx512_bf16::prune},
#if defined(X86_TILES)
    {amx::denoise, amx::run_blocks, amx::prune},
#endif
#endif
};

#if defined(X86_TILES)
// Whether the CPU has AMX, and Linux lets this process use it, for which it has to be asked.
bool has_tiles() {
    constexpr unsigned int NEEDED = 1u << 22 | 1u << 24;  // of BF16, and any
    constexpr long REQUEST = 0x1023, TILE_DATA = 18;  // ARCH_REQ_XCOMP_PERM of XFEATURE_XTILEDATA
    unsigned int a, b, c, d;
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d) || (d & NEEDED) != NEEDED) return false;
    return syscall(SYS_arch_prctl, REQUEST, TILE_DATA) == 0;
}
#endif

// Instruction sets that this CPU can run: so many of LEVELS, from the first.
int32_t levels() {
#if defined(ARM)
    return 2;
#elif defined(X86)
    if (!__builtin_cpu_supports("avx2") || !__builtin_cpu_supports("fma")) return 1;
    if (!__builtin_cpu_supports("avx512f")) return 2;
    if (!__builtin_cpu_supports("avx512bf16") || !__builtin_cpu_supports("avx512vnni")) return 3;
#if defined(X86_TILES)
    return has_tiles() ? 5 : 4;
#else
    return 4;
#endif
#else
    return 1;
#endif
}
}  // namespace

#else  // -------------------------------------------------------------- compiled once for each instruction set
// No function of another header may be called here: the linker could keep the copy for the wrong instruction set.

#if !defined(TARGET)
#elif defined(__clang__)
PRAGMA(clang attribute push(__attribute__((target(TARGET))), apply_to = function))
#else
#pragma GCC push_options
PRAGMA(GCC target(TARGET))
#endif

namespace {
namespace LEVEL {

#define INLINE static inline __attribute__((always_inline))
typedef float V __attribute__((vector_size(4 * VECTOR)));
typedef int32_t I __attribute__((vector_size(4 * VECTOR)));
typedef half H __attribute__((vector_size(2 * VECTOR)));
typedef uint8_t B __attribute__((vector_size(VECTOR)));
typedef float Unaligned __attribute__((vector_size(4 * VECTOR), aligned(4), may_alias));
typedef half UnalignedHalf __attribute__((vector_size(2 * VECTOR), aligned(2), may_alias));
typedef uint8_t UnalignedBytes __attribute__((vector_size(VECTOR), aligned(1), may_alias));
typedef int32_t UnalignedInts __attribute__((vector_size(4 * VECTOR), aligned(4), may_alias));

#if defined(NEON)
constexpr int REGISTERS = 32;
#else
constexpr int REGISTERS = VECTOR == 16 ? 32 : 16;
#endif
// Rows of a tile. 16 are the longest published horizon; 6 rows x 2 vectors of sums, 2 of weights and 1 of activations fill
// 15 of 16 registers.
constexpr int MAX_ROWS = REGISTERS == 32 ? 16 : 6;

INLINE V load(const float* p) { return *(const Unaligned*)p; }
INLINE V load(const Pair* p) { return *(const Unaligned*)p; }
INLINE V load(const Quad* p) { return *(const Unaligned*)p; }
INLINE void store(float* p, V v) { *(Unaligned*)p = v; }
INLINE V splat(float f) { return f - V{}; }  // not V{} + f, which is not f if f is -0 and so costs an addition

INLINE V load(const half* p) {
#if VECTOR == 16
    return _mm512_cvtph_ps(_mm256_loadu_si256((const __m256i*)p));
#elif VECTOR == 8
    return _mm256_cvtph_ps(_mm_loadu_si128((const __m128i*)p));
#elif defined(NEON)
    return (V)vcvt_f32_f16(vreinterpret_f16_u16(vld1_u16(p)));
#else
    const I bits = __builtin_convertvector(*(const UnalignedHalf*)p, I);
    // The exponents of f16 and f32 differ by 112; multiplying is right for subnormal numbers as well.
    const V magnitude = (V)((bits & 0x7fff) << 13) * 0x1p112f;
    return (V)((I)magnitude | (bits & 0x8000) << 16);
#endif
}

// sums + weights * activations: of one input, of a pair of them, or of four, in integers.
INLINE V accumulate(V sums, V weights, V x, const float*) { return sums + weights * x; }
INLINE V accumulate(V sums, V weights, V x, const half*) { return sums + weights * x; }
INLINE V accumulate(V sums, V weights, V x, const Pair*) {
#if defined(DOTS)
    return _mm512_dpbf16_ps(sums, (__m512bh)weights, (__m512bh)x);
#else
    const int second = ~0xffff;  // BF16 is the upper half of F32
    sums += (V)((I)weights << 16) * (V)((I)x << 16);
    return sums + (V)((I)weights & second) * (V)((I)x & second);
#endif
}
INLINE I accumulate(I sums, V weights, V x, const Quad*) {
#if defined(DOTS)
    return (I)_mm512_dpbusd_epi32((__m512i)sums, (__m512i)x, (__m512i)weights);
#else
#pragma GCC unroll 4
    for (int shift = 0; shift < 32; shift += 8) sums += ((I)weights << (24 - shift) >> 24) * ((I)x >> shift & 0xff);
    return sums;
#endif
}

template <class T> struct Sums { typedef V type; };
template <> struct Sums<Quad> { typedef I type; };

INLINE float sum(V v) {
#if VECTOR == 16
    return _mm512_reduce_add_ps(v);
#else
    float total = 0;
    for (int i = 0; i < VECTOR; i++) total += v[i];
    return total;
#endif
}

INLINE V lesser(V a, V c) { return a < c ? a : c; }
INLINE V greater(V a, V c) { return a > c ? a : c; }

INLINE float least(V v) {
#if VECTOR == 16
    return _mm512_reduce_min_ps(v);
#else
    float found = v[0];
    for (int i = 1; i < VECTOR; i++) found = v[i] < found ? v[i] : found;
    return found;
#endif
}

INLINE float greatest(V v) {
#if VECTOR == 16
    return _mm512_reduce_max_ps(v);
#else
    float found = v[0];
    for (int i = 1; i < VECTOR; i++) found = v[i] > found ? v[i] : found;
    return found;
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

INLINE V relu(V x) { return x > 0.f ? x : V{}; }

// x * tanh(ln(1 + e^x)), written with e^x alone.
INLINE V mish(V x) {
    const V e = exponential(x < 20.f ? x : splat(20.f));
    const V n = e * (e + 2.f);
    return x * (n / (n + 2.f));
}

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

// One query, or one thread's share of it.
struct Query {
    const Model& m;
    const Buffers b;
    const int slots;
    const Member who;
    const Range rows;  // of the horizon, this thread's

    Query(const Model& m, int slots, const Member& who, float* own, float* shared)
        : m(m), b(m, slots, own, shared), slots(slots), who(who), rows(share(m.horizon)) {}

    // This thread's of n items.
    Range share(int n) const { return {n * who.rank / who.size, n * (who.rank + 1) / who.size}; }

    // This thread's columns of a product.
    Range share(const Matrix& a) const {
        const Range panels = share(a.columns / PANEL);
        return {panels.first * PANEL, panels.last * PANEL};
    }

    // Whether several blocks leave their outputs in one slot.
    bool shares_slots() const { return slots < 3 * m.layers; }

    // Whether action t may not look at action s or, in the memory, at token s.
    bool hidden(int s, int t) const { return m.causal && s > t; }

    void product(const float* x, int ldx, int n, const Matrix& a, Range columns, float* y, int ldy) const {
        if (a.type == F32) return multiply<float>(x, ldx, n, a, columns, y, ldy);
        if (a.type == F16) return multiply<half>(x, ldx, n, a, columns, y, ldy);
        if (a.type == I8) return integer_product(x, ldx, n, a, columns, y, ldy);
        const int ld_rounded = b.ldh / 2;
        for (int t = 0; t < n; t++) round(x + t * ldx, 2 * a.rows, b.rounded + t * ld_rounded);
        multiply<Pair>(b.rounded, ld_rounded, n, a, columns, y, ldy);
    }

    void whole_product(const float* x, int ldx, int n, const Matrix& a, float* y, int ldy) const {
        product(x, ldx, n, a, {0, a.columns}, y, ldy);
    }

    // f32 to BF16, to nearest even. `x` is padded to whole vectors.
    static void round(const float* x, int n, float* pairs) {
        for (int j = 0; j < n; j += VECTOR) {
            const I bits = (I)load(x + j);
            *(UnalignedHalf*)((half*)pairs + j) = __builtin_convertvector((bits + 0x7fff + (bits >> 16 & 1)) >> 16, H);
        }
    }

    // x = step * (q - zero) in each row, with q in a byte, so that x * weight = step * scale * (q * w - zero * sum of w): the
    // sums are exact, whatever their order. Those of up to 2^15 inputs fit into i32.
    void integer_product(const float* x, int ldx, int n, const Matrix& a, Range columns, float* y, int ldy) const {
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
    static void quantise(const float* x, int n, uint8_t* bytes, float* grid) {
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
    void normalise(Range rows) const {
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

    // Scores lie as [key][lane], a lane being one head of one query: n keys are summed up without leaving the vector.
    float& score(int key, int t, int h) const { return b.scores[(size_t)key * b.lanes + t * m.heads + h]; }

    // Of this thread's rows, and of what else their vectors hold.
    void softmax(int n) const {
        for (int lane = rows.first * m.heads / VECTOR * VECTOR; lane < rows.last * m.heads; lane += VECTOR) {
            float* const s = b.scores + lane;
            V most = load(s), total{};
            for (int i = 1; i < n; i++) {
                const V v = load(s + (size_t)i * b.lanes);
                most = v > most ? v : most;
            }
            for (int i = 0; i < n; i++) {
                const V e = exponential(load(s + (size_t)i * b.lanes) - most);
                store(s + (size_t)i * b.lanes, e);
                total += e;
            }
            const V scale = 1.f / total;
            for (int i = 0; i < n; i++) store(s + (size_t)i * b.lanes, load(s + (size_t)i * b.lanes) * scale);
        }
    }

    void self_attention(const Layer& layer, float* d) const {
        const int part = padded(b.inner), ldq = stride(3 * part), ldm = stride(b.inner), head = b.head;
        product(b.y, b.ld, m.horizon, layer.qkv, share(layer.qkv), b.qkv, ldq);
        who.meet();
        const float *keys = b.qkv + part, *values = keys + part;
        for (int t = rows.first; t < rows.last; t++)
            for (int h = 0; h < m.heads; h++)
                for (int s = 0; s < m.horizon; s++)
                    score(s, t, h) = hidden(s, t) ? UNSEEN : dot(b.qkv + t * ldq + h * head, keys + s * ldq + h * head, head);
        softmax(m.horizon);
        for (int t = rows.first; t < rows.last; t++)
            for (int h = 0; h < m.heads; h++)
                for (int j = h * head; j < h * head + head; j += VECTOR) {
                    V total{};
                    for (int s = 0; s < m.horizon && !hidden(s, t); s++) total += load(values + s * ldq + j) * score(s, t, h);
                    store(b.mixed + t * ldm + j, total);
                }
        who.meet();
        product(b.mixed, ldm, m.horizon, layer.out, share(layer.out), d, b.ld);
    }

    static void copy(const float* from, size_t n, float* to) {
        for (size_t i = 0; i < n; i++) to[i] = from[i];
    }

    // Index of the first folded vector of a layer and an observation.
    size_t memory(int layer, int observation) const { return ((size_t)layer * m.obs_steps + observation) * m.heads; }

    // What cross-attention reads of a step that no other reads. Weights have driven it out of the caches.
    void fetch(int step, int index) const {
        const size_t first = ((size_t)step * m.layers + index) * m.heads * b.width;
        for (int j = 0; j < m.heads * b.width; j += 16) {
            __builtin_prefetch(m.time_key + first + j, 0, 2);
            __builtin_prefetch(m.time_value + first + j, 0, 2);
        }
    }

    // Scores and outputs are products with the folded memory: 1 + obs_steps vectors for each head and side.
    void cross_attention(int step, int index, bool read, float* d) const {
        // Token 0 is the denoising step, which all actions see; token s the observation s - 1.
        const size_t time = ((size_t)step * m.layers + index) * m.heads;
        auto token = [&](int s, const float* of_time, const float* of_observations, int size) {
            return s ? of_observations + memory(index, s - 1) * size : of_time + time * size;
        };
        for (int s = 0; s <= m.obs_steps; s++) {
            const float* const keys = token(s, m.time_key, b.key, b.width);
            const float* const biases = token(s, m.time_bias, b.key_bias, 1);
            for (int t = rows.first; t < rows.last; t++)
                for (int h = 0; h < m.heads; h++)
                    score(s, t, h) = hidden(s - 1, t)
                        ? UNSEEN : dot(b.y + t * b.ld, keys + (size_t)h * b.width, b.width) + biases[h];
        }
        softmax(1 + m.obs_steps);
        if (read || shares_slots()) who.meet();  // until all have read what a cross-attention left in the same slot
        for (int t = rows.first; t < rows.last; t++)
            for (int j = 0; j < b.width; j += VECTOR) {
                V total = load(m.layer[index].cross_bias + j);
                for (int s = 0; s <= m.obs_steps && !hidden(s - 1, t); s++) {
                    const float* const values = token(s, m.time_value, b.value, b.width) + j;
                    for (int h = 0; h < m.heads; h++) total += load(values + (size_t)h * b.width) * score(s, t, h);
                }
                store(d + t * b.ld + j, total);
            }
    }

    // This thread's columns of hidden = activation(x * up).
    void expand(const float* x, int ldx, int n, const Matrix& up, Activation kind) const {
        const Range columns = share(up);
        product(x, ldx, n, up, columns, b.hidden, b.ldh);
        for (int t = 0; t < n; t++)
            for (int j = columns.first; j < columns.last; j += VECTOR) {
                float* const p = b.hidden + t * b.ldh + j;
                store(p, kind == GELU ? gelu(load(p)) : mish(load(p)));
            }
    }

    void feed_forward(const Layer& layer, float* d) const {
        expand(b.y, b.ld, m.horizon, layer.up, GELU);
        who.meet();
        product(b.hidden, b.ldh, m.horizon, layer.down, share(layer.down), d, b.ld);
    }

    // x += what a block adds. `read`: whether outputs of blocks have been reused since the block before.
    void compute(int step, int block, bool read) const {
        float* const d = b.latest + (size_t)(block % slots) * m.horizon * b.ld;
        const int index = block / 3, kind = block % 3;
        if (kind == 0) fetch(step, index);
        normalise(kind == 1 ? rows : Range{0, m.horizon});
        if (kind == 0) self_attention(m.layer[index], d);
        if (kind == 1) cross_attention(step, index, read, d);
        if (kind == 2) feed_forward(m.layer[index], d);
        who.meet();
        for (int i = 0; i < m.horizon * b.ld; i += VECTOR) store(b.x + i, load(b.x + i) + load(d + i));
    }

    // to [horizon, width] = from + what the blocks first .. last-1 add, in one pass.
    void reuse(const float* from, int ld_from, float* to, int ld_to, int first, int last) const {
        const bool shared = shares_slots();  // a slot counts as often as its blocks occur
        const int begin = shared ? 0 : first, end = shared ? slots : last;
        for (int t = 0; t < m.horizon; t++)
            for (int j = 0; j < b.width; j += VECTOR) {
                V total = load(from + t * ld_from + j);
                for (int s = begin; s < end; s++) {
                    const int before = slots - 1 - s;
                    const float times = shared ? (last + before) / slots - (first + before) / slots : 1;
                    total += load(b.latest + ((size_t)s * m.horizon + t) * b.ld + j) * times;
                }
                store(to + t * ld_to + j, total);
            }
    }

    // Encodes the observations and folds them into the cross-attention of every layer.
    void encode(const float* cond) const {
        const int n = m.obs_steps;
        expand(cond, m.cond_dim, n, m.encode_up, MISH);
        who.meet();
        product(b.hidden, b.ldh, n, m.encode_down, share(m.encode_down), b.token, b.ld);
        who.meet();
        const Range layers = share(m.layers);
        for (int i = layers.first; i < layers.last; i++) fold(i);
        who.meet();
    }

    void fold(int index) const {
        const int n = m.obs_steps, part = padded(b.inner), ldk = stride(2 * part);
        const Layer& layer = m.layer[index];
        const size_t first = memory(index, 0);
        whole_product(b.token, b.ld, n, layer.kv, b.kv, ldk);
        for (int side = 0; side < 2; side++)
            for (int h = 0; h < m.heads; h++)
                whole_product(b.kv + side * part + h * b.head, ldk, n, layer.fold[side * m.heads + h],
                              (side ? b.value : b.key) + (first + h) * b.width, m.heads * b.width);
        for (int o = 0; o < n; o++)
            for (int h = 0; h < m.heads; h++)
                b.key_bias[first + o * m.heads + h] = dot(b.kv + o * ldk + h * b.head, layer.query_bias + h * b.head, b.head);
    }

    // Predicts the noise from the residual stream and takes the sampler's step, with MEMORY of earlier clean predictions,
    // GUIDED to actions.
    template <bool MEMORY, bool GUIDED>
    void advance(int step, const float* noise, const Guide& guide) const {
        normalise({0, m.horizon});
        const int lda = stride(m.action_dim);
        whole_product(b.y, b.ld, m.horizon, m.head, b.eps, lda);
        const float* c = m.coefficients + 8 * step;
        float* const previous = b.cleans;
        float* const earlier = previous + m.horizon * lda;
        for (int t = 0; t < m.horizon; t++)
            for (int j = 0; j < m.action_dim; j++) {
                float& sample = b.sample[t * lda + j];
                const float eps = b.eps[t * lda + j];
                float clean = (sample - c[0] * eps) / c[1];
                clean = clean > m.clip ? m.clip : clean < -m.clip ? -m.clip : clean;
                if constexpr (GUIDED) clean += guide.pull[t] * (guide.actions[t * m.action_dim + j] - clean);
                float next = c[2] * clean + c[3] * sample + c[4] * eps;
                if constexpr (MEMORY) {
                    const int at = t * lda + j;
                    next += c[5] * previous[at] + c[6] * earlier[at];
                    earlier[at] = previous[at];
                    previous[at] = clean;
                }
                sample = noise ? next + c[7] * noise[t * m.action_dim + j] : next;
            }
    }

    template <bool GUIDED>
    void finish(int step, const float* noise, const Guide& guide) const {
        m.history ? advance<true, GUIDED>(step, noise, guide) : advance<false, GUIDED>(step, noise, guide);
    }

    void run(const uint8_t* pruned, const float* noise, const float* cond, const Guide& guide, float* actions) const {
        const int lda = stride(m.action_dim), size = m.horizon * m.action_dim, blocks = 3 * m.layers;
        encode(cond);
        Matrix constant = m.embed;  // of a step without a computed block: what all of them add goes into the bias
        constant.bias = b.constant;
        bool known = false;  // whether b.constant is of the latest outputs
        bool read = false;
        for (int t = 0; t < m.horizon; t++) copy(noise + t * m.action_dim, m.action_dim, b.sample + t * lda);
        if (m.history)
            for (int i = 0; i < 2 * m.horizon * lda; i++) b.cleans[i] = 0;
        for (int step = 0; step < m.steps; step++, pruned += blocks) {
            const bool empty = run_end(pruned, 0, blocks) == blocks;
            if (empty && !known) reuse(m.embed.bias, b.width, b.constant, b.width, 0, blocks);
            known = empty;
            read = read || empty;
            whole_product(b.sample, lda, m.horizon, empty ? constant : m.embed, b.x, b.ld);
            for (int block = empty ? blocks : 0, end; block < blocks; block = end + 1) {
                end = run_end(pruned, block, blocks);
                if (end > block) reuse(b.x, b.ld, b.x, b.ld, block, end);
                read = read || end > block;
                if (end == blocks) break;
                compute(step, end, read), read = false;
            }
            const float* const gaussian = step + 1 < m.steps ? noise + (size_t)(step + 1) * size : nullptr;
            guide.actions ? finish<true>(step, gaussian, guide) : finish<false>(step, gaussian, guide);
        }
        for (int t = rows.first; t < rows.last; t++) copy(b.sample + t * lda, m.action_dim, actions + t * m.action_dim);
    }

    // The first block from `block` on that is computed: pruned ones before it add a sum of what is there already.
    static int run_end(const uint8_t* pruned, int block, int blocks) {
        while (block < blocks && pruned[block]) block++;
        return block;
    }
};

void denoise(const Model& m, const Member& who, const uint8_t* pruned, int slots, const float* noise, const float* cond,
             const Guide& guide, float* actions, float* own, float* shared) {
    Query(m, slots, who, own, shared).run(pruned, noise, cond, guide, actions);
}

void run_blocks(const Model& m, const Member& who, int kind, float* own, float* shared) {
    const Query query(m, 3, who, own, shared);
    for (int layer = 0; layer < m.layers; layer++) query.compute(0, 3 * layer + kind, false);
}

// One observation's logits = relu(relu(cells + observation * obs) * middle) . last, a group of cells after the other.
void prune(const Pruner& p, const Member& who, const float* observation, float* logits, uint8_t* mask) {
    // With so many rows, a tile holds two vectors of each in registers: half the loads of one with MAX_ROWS.
    constexpr int GROUP = REGISTERS == 32 ? 12 : MAX_ROWS;
    constexpr int ld = stride(MAX_HIDDEN);
    alignas(64) float added[ld], x[GROUP * ld], y[GROUP * ld];
    const int width = p.middle.columns;
    multiply<float>(observation, 0, 1, p.obs, {0, p.obs.columns}, added, 0);
    for (int first = who.rank * GROUP; first < p.count; first += who.size * GROUP) {
        const int n = p.count - first < GROUP ? p.count - first : GROUP;
        for (int c = 0; c < n; c++)
            for (int j = 0; j < width; j += VECTOR) {
                const float* const cell = p.cells + (size_t)(first + c) * width + j;
                // A policy's weights have driven the cells out of the cache.
                __builtin_prefetch(cell + (size_t)2 * who.size * GROUP * width);
                store(x + c * ld + j, relu(load(cell) + load(added + j)));
            }
        multiply<float>(x, ld, n, p.middle, {0, width}, y, ld);
        for (int c = 0; c < n; c++) {
            V total{};
            for (int j = 0; j < width; j += VECTOR) total += relu(load(y + c * ld + j)) * load(p.last + j);
            const float logit = p.bias + sum(total);
            if (logits) logits[first + c] = logit;
            if (mask) mask[first + c] = logit > 0.f && first + c >= p.first;
        }
    }
}

#undef INLINE
}  // namespace LEVEL
}  // namespace

#if !defined(TARGET)
#elif defined(__clang__)
#pragma clang attribute pop
#else
#pragma GCC pop_options
#endif
#undef LEVEL
#undef VECTOR
#undef TARGET
#undef DOTS
#undef TILES
#undef NEON
#endif
