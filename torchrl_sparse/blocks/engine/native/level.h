// The kernels of one instruction set. denoise.h includes this once for each, having defined:
//   LEVEL, the namespace; VECTOR, numbers in a vector; TARGET, what the compiler may use beyond the machine's minimum;
//   DOTS, dot products of BF16 and of 8 bits; TILES, AMX; NEON.
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

#include "vectors.h"
#include "amx.h"
#include "kernels.h"
#include "query.h"
#include "products.h"
#include "attention.h"
#include "blocks.h"
#include "sampler.h"
#include "pruner.h"

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
