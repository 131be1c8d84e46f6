// The vectors of an instruction set: loads, sums, reductions, and the activation functions.
// Part of level.h, once for each instruction set: may call only what level.h includes before it.

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
