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
//   including level.h once for each. The caller chooses one of LEVELS at run time.

#pragma once

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

#include "buffers.h"
#include "member.h"

#define EXPANDED(text) _Pragma(#text)
#define PRAGMA(text) EXPANDED(text)

#define LEVEL portable
#define VECTOR 4
#include "level.h"
#if defined(ARM)  // always has NEON: the portable vectors are its own, and there are twice as many registers
#define LEVEL neon
#define VECTOR 4
#define NEON
#include "level.h"
#elif defined(X86)
#define LEVEL avx2
#define VECTOR 8
#define TARGET "avx2,fma,f16c"
#include "level.h"
#define LEVEL avx512
#define VECTOR 16
#define TARGET "avx512f,avx2,fma,f16c"
#include "level.h"
#define LEVEL avx512_bf16
#define VECTOR 16
#define TARGET "avx512bf16,avx512vnni,avx512f,avx2,fma,f16c"
#define DOTS
#include "level.h"
#if defined(X86_TILES)
#define LEVEL amx
#define VECTOR 16
#define TARGET "amx-tile,amx-bf16,avx512bf16,avx512vnni,avx512f,avx2,fma,f16c"
#define DOTS
#define TILES
#include "level.h"
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
