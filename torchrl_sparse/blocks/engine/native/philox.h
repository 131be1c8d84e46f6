// The noise of networks/diffusion/philox.py, to the last bit, and why it can be: see there.

#pragma once

#include <stddef.h>
#include <stdint.h>

namespace philox {

// A product that is fused with a sum is rounded once instead of twice.
#if defined(__clang__)
#define SEPARATE
#define SEPARATELY _Pragma("clang fp contract(off)")
#else
#define SEPARATE __attribute__((noinline, optimize("fp-contract=off")))
#define SEPARATELY
#endif

struct Words { uint32_t at[4]; };

inline Words words(uint64_t key, uint64_t counter) {
    Words w{{(uint32_t)counter, (uint32_t)(counter >> 32), 0, 0}};
    uint32_t first_key = (uint32_t)key, second_key = (uint32_t)(key >> 32);
    for (int round = 0; round < 10; round++) {
        const uint64_t first = (uint64_t)w.at[0] * 0xD2511F53u, second = (uint64_t)w.at[2] * 0xCD9E8D57u;
        w = {{(uint32_t)(second >> 32) ^ w.at[1] ^ first_key, (uint32_t)second,
              (uint32_t)(first >> 32) ^ w.at[3] ^ second_key, (uint32_t)first}};
        first_key += 0x9E3779B9u;
        second_key += 0xBB67AE85u;
    }
    return w;
}

constexpr double MIDDLE[2][8] = {
    {2.5090809287301226727e3, 3.3430575583588128105e4, 6.7265770927008700853e4, 4.5921953931549871457e4,
     1.3731693765509461125e4, 1.9715909503065514427e3, 1.3314166789178437745e2, 3.3871328727963666080e0},
    {5.2264952788528545610e3, 2.8729085735721942674e4, 3.9307895800092710610e4, 2.1213794301586595867e4,
     5.3941960214247511077e3, 6.8718700749205790830e2, 4.2313330701600911252e1, 1.0}};
constexpr double TAIL[2][8] = {
    {7.74545014278341407640e-4, 2.27238449892691845833e-2, 2.41780725177450611770e-1, 1.27045825245236838258e0,
     3.64784832476320460504e0, 5.76949722146069140550e0, 4.63033784615654529590e0, 1.42343711074968357734e0},
    {1.05075007164441684324e-9, 5.47593808499534494600e-4, 1.51986665636164571966e-2, 1.48103976427480074590e-1,
     6.89767334985100004550e-1, 1.67638483018380384940e0, 2.05319162663775882187e0, 1.0}};
constexpr double LOGARITHM[10] = {1. / 19, 1. / 17, 1. / 15, 1. / 13, 1. / 11, 1. / 9, 1. / 7, 1. / 5, 1. / 3, 1.};

template <int N>
SEPARATE double polynomial(const double (&coefficients)[N], double x) {
    SEPARATELY
    double total = coefficients[0];
    for (int i = 1; i < N; i++) {
        total = total * x;
        total = total + coefficients[i];
    }
    return total;
}

// ln x of (0, 1].
SEPARATE inline double logarithm(double x) {
    SEPARATELY
    int exponent;
    double mantissa = __builtin_frexp(x, &exponent);
    if (mantissa < 0.7071067811865476) {
        mantissa = mantissa * 2;
        exponent--;
    }
    const double s = (mantissa - 1) / (mantissa + 1);
    const double series = polynomial(LOGARITHM, s * s);
    return exponent * 0.6931471805599453 + 2 * s * series;
}

// Phi^-1 of [2^-33, 1 - 2^-33].
SEPARATE inline double normal_quantile(double p) {
    SEPARATELY
    const double q = p - 0.5;
    if (q <= 0.425 && q >= -0.425) {
        const double near = 0.180625 - q * q;
        return q * polynomial(MIDDLE[0], near) / polynomial(MIDDLE[1], near);
    }
    const double far = __builtin_sqrt(-logarithm(q < 0 ? p : 1 - p)) - 1.6;
    const double tail = polynomial(TAIL[0], far) / polynomial(TAIL[1], far);
    return q < 0 ? -tail : tail;
}

// The first n numbers of a seed.
inline void fill(uint64_t seed, size_t n, float* numbers) {
    for (size_t i = 0; i < n; i += 4) {
        const Words w = words(seed, i / 4);
        for (size_t j = 0; j < 4 && i + j < n; j++) numbers[i + j] = (float)normal_quantile((w.at[j] + 0.5) * 0x1p-32);
    }
}

#undef SEPARATE
#undef SEPARATELY

}  // namespace philox
