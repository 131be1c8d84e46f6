// The compiled engine as Python calls it, through ctypes (library.py), which releases the interpreter's lock.

#include <atomic>
#include <cstddef>
#include <cstdint>

#include "denoise.h"
#include "team.h"
#include "units.h"

namespace {

// Queries of one network and their memory: a piece of `piece` floats for each of `threads` threads, on cache lines.
struct Batch {
    const Level& level;
    const Model& m;
    const int32_t rows, slots;
    const uint8_t* const pruned;
    const size_t mask;  // from a row's to the next; 0 if all have the same
    const float *const noise, *const cond;
    const Guide guide;  // of the first row
    float *const actions, *const scratch;
    const size_t piece = Buffers(m, slots, nullptr, nullptr).size;
    std::atomic<int32_t> next{0};

    void query(const Member& who, ptrdiff_t row, float* own, float* shared) const {
        const ptrdiff_t chunk = (ptrdiff_t)m.horizon * m.action_dim;
        const Guide drawn = guide.actions ? Guide{guide.actions + row * chunk, guide.pull + row * m.horizon} : guide;
        level.denoise(m, who, pruned + row * mask, slots, noise + row * m.steps * chunk,
                      cond + row * m.obs_steps * m.cond_dim, drawn, actions + row * chunk, own, shared);
    }

    // Rows go to one thread each, the next to whichever is free; those that are left and fewer than threads, to all together.
    void work(const Member& who) {
        const int32_t alone = rows / who.size * who.size;
        float* const own = scratch + who.rank * piece;
        for (int32_t row; (row = next.fetch_add(1)) < alone;) query(Member{}, row, own, own);
        for (int32_t row = alone; row < rows; row++) {
            who.barrier();
            query(who, row, own, scratch);
        }
    }
};

template <class Task>
void run(int32_t threads, Task& task) {
    Team::run(threads, [](const Member& who, void* data) { (*static_cast<Task*>(data))(who); }, &task);
}

}  // namespace

extern "C" {

int32_t sparse_levels() { return levels(); }

// For the caller to compare with its own: a library that was built from other sources has other functions and structures.
uint64_t sparse_layout() {
    constexpr uint64_t HASH = layout_hash();
    return HASH;
}

// Floats that each thread needs as scratch, which must start on a cache line (64 bytes).
int64_t sparse_scratch(const Model* m, int32_t slots) { return (int64_t)Buffers(*m, slots, nullptr, nullptr).size; }

// For each of n rows: pruned [steps][3 * layers], noise [steps][horizon][action_dim], cond [obs_steps][cond_dim] -> actions
// [horizon][action_dim]. The latest outputs are kept in `slots` places: one for each block, 3 (one for each type), or 1.
// guide [horizon][action_dim] and pull [horizon] of each row are what its clean predictions are drawn to, unless they are null.
void sparse_denoise(int32_t level, int32_t threads, const Model* m, int32_t n, const uint8_t* pruned, int32_t slots,
                    const float* noise, const float* cond, const float* guide, const float* pull, float* actions,
                    float* scratch) {
    const size_t mask = (size_t)m->steps * 3 * m->layers;
    Batch batch{LEVELS[level], *m, n, slots, pruned, mask, noise, cond, {guide, pull}, actions, scratch};
    auto task = [&](const Member& who) { batch.work(who); };
    run(threads, task);
}

// states [n][dim] in the units of the environment -> those of the policy. Returns whether all of them are finite.
int32_t sparse_normalise(const Units* units, int32_t n, int32_t dim, const float* states, float* cond) {
    return normalise(*units, states, n, dim, cond);
}

// The same as sparse_denoise, of noise and condition alone, to chunks [horizon - obs_steps + 1][action_dim] in the units of the
// environment, with one mask for all rows; actions are written too.
void sparse_answer(int32_t level, int32_t threads, const Model* m, int32_t n, const uint8_t* pruned, int32_t slots,
                   const float* noise, const Units* units, const float* cond, float* actions, float* chunks, float* scratch) {
    Batch batch{LEVELS[level], *m, n, slots, pruned, 0, noise, cond, {}, actions, scratch};
    auto task = [&](const Member& who) { batch.work(who); };
    run(threads, task);
    const size_t past = m->obs_steps - 1, steps = m->horizon - past, dim = m->action_dim;
    for (size_t row = 0; row < (size_t)n; row++)
        unnormalise(*units, actions + (row * m->horizon + past) * dim, steps, dim, chunks + row * steps * dim);
}

// To be timed by the caller: runs the blocks of `kind` (0 SA, 1 CA, 2 FFN) of all layers.
void sparse_blocks(int32_t level, int32_t threads, const Model* m, int32_t kind, float* scratch) {
    const size_t piece = Buffers(*m, 3, nullptr, nullptr).size;
    auto task = [&](const Member& who) { LEVELS[level].run_blocks(*m, who, kind, scratch + who.rank * piece, scratch); };
    run(threads, task);
}

// What lies at n places.
void sparse_gather(int32_t n, const float* const* places, float* values) {
    for (int32_t i = 0; i < n; i++) __builtin_prefetch(places[i]);  // none is in a cache, and they are nowhere near each other
    for (int32_t i = 0; i < n; i++) values[i] = *places[i];
}

// observations [n][obs.rows] -> logits [n][count], or which of them are positive, none of the first step; the other is null.
void sparse_prune(int32_t level, int32_t threads, const Pruner* pruner, int32_t n, const float* observations, float* logits,
                  uint8_t* masks) {
    auto task = [&](const Member& who) {
        for (ptrdiff_t i = 0; i < n; i++)
            LEVELS[level].prune(*pruner, who, observations + i * pruner->obs.rows, logits ? logits + i * pruner->count : nullptr,
                                masks ? masks + i * pruner->count : nullptr);
    };
    run(threads, task);
}
}
