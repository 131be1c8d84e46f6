// The C interface of tsp.h: runs what tsp_reader.h has read in the kernels of denoise.h. Neither exceptions nor the library of
// C++ are used.

#include "tsp.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "denoise.h"
#include "philox.h"
#include "tsp_reader.h"
#include "units.h"

namespace {

tsp_policy* adopt(uint8_t* bytes, size_t size, Message& message) {
    tsp_policy* const policy = (tsp_policy*)calloc(1, sizeof(tsp_policy));
    if (!policy) {
        message.write("expected memory for the policy, there is none");
        return free(bytes), nullptr;
    }
    policy->bytes = bytes;
    if (Reader(*policy, size, message).read()) return policy;
    return tsp_free(policy), nullptr;
}

// Of so many bytes, or a message and null.
uint8_t* room(size_t size, Message& message) {
    uint8_t* const memory = (uint8_t*)on_line(size);
    if (!memory) message.write("expected memory for %zu bytes, there is none", size);
    return memory;
}

// The bytes of a file, or a message and null.
uint8_t* read_file(FILE* file, size_t& size, Message& message) {
    struct stat status;
    if (fstat(fileno(file), &status) || !S_ISREG(status.st_mode)) {
        message.write("expected a regular file");
        return nullptr;
    }
    size = (size_t)status.st_size;
    uint8_t* const bytes = room(size, message);
    if (!bytes) return nullptr;
    const size_t got = fread(bytes, 1, size, file);
    if (got == size) return bytes;
    message.write("size: expected %zu bytes, could read %zu", size, got);
    return free(bytes), nullptr;
}

// As numbers that compare like the floats, and so that a NaN has a place among them.
int32_t ordered(float value) {
    int32_t bits;
    memcpy(&bits, &value, sizeof bits);
    return bits >= 0 ? bits : (int32_t)(0x80000000u - (uint32_t)bits);
}

float unordered(int32_t key) {
    const int32_t bits = key >= 0 ? key : (int32_t)(0x80000000u - (uint32_t)key);
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

// The value that would be number k from the largest on, of n keys, which are moved about (Hoare's selection).
int32_t select(int32_t* keys, int32_t n, int32_t k) {
    for (int32_t low = 0, high = n - 1; low < high;) {
        const int32_t pivot = keys[low + (high - low) / 2];
        int32_t i = low, j = high;
        while (i <= j) {
            while (keys[i] > pivot) i++;
            while (keys[j] < pivot) j--;
            if (i > j) break;
            const int32_t swapped = keys[i];
            keys[i++] = keys[j];
            keys[j--] = swapped;
        }
        if (k <= j) high = j;
        else if (k >= i) low = i;
        else break;
    }
    return keys[k];
}

void decide(tsp_policy& p) {
    const Pruner& pruner = p.pruner;
    if (!p.h.rated) return LEVELS[p.level].prune(pruner, Member{}, p.features, nullptr, p.mask);
    LEVELS[p.level].prune(pruner, Member{}, p.features, p.logits, nullptr);
    const int32_t n = p.cells - pruner.first;
    for (int32_t i = 0; i < n; i++) p.order[i] = ordered(p.logits[pruner.first + i]);
    const float last = unordered(select(p.order, n, p.h.pruned - 1)), next = unordered(select(p.order, n, p.h.pruned));
    const float threshold = (last + next) / 2;
    for (int32_t i = pruner.first; i < p.cells; i++) p.mask[i] = p.logits[i] > threshold;
}

}  // namespace

extern "C" {

tsp_policy* tsp_load(const char* path, char* error, size_t error_size) {
    Message message{error, error_size};
    message.write("%s: ", path);
    FILE* const file = fopen(path, "rb");
    if (!file) {
        message.write("expected a file that can be read (%s)", strerror(errno));
        return nullptr;
    }
    size_t size = 0;
    uint8_t* const bytes = read_file(file, size, message);
    fclose(file);
    return bytes ? adopt(bytes, size, message) : nullptr;
}

tsp_policy* tsp_load_memory(const void* bytes, size_t size, char* error, size_t error_size) {
    Message message{error, error_size};
    uint8_t* const copy = room(size, message);
    if (!copy) return nullptr;
    memcpy(copy, bytes, size);
    return adopt(copy, size, message);
}

tsp_info tsp_describe(const tsp_policy* policy) {
    const Header& h = policy->h;
    return {h.obs_steps, h.cond_dim, h.horizon - h.obs_steps + 1, h.action_dim, h.steps, policy->text};
}

int tsp_query(tsp_policy* policy, const float* history, uint64_t seed, float* chunk) {
    tsp_policy& p = *policy;
    const Header& h = p.h;
    if (!normalise(p.units, history, h.obs_steps, h.cond_dim, p.features)) return TSP_NOT_FINITE;
    philox::fill(seed, (size_t)h.steps * h.horizon * h.action_dim, p.noise);
    if (h.plan == PRUNER) decide(p);
    LEVELS[p.level].denoise(p.model, Member{}, p.mask, h.slots, p.noise, p.features, Guide{}, p.actions, p.scratch, p.scratch);
    const int32_t past = h.obs_steps - 1;
    unnormalise(p.units, p.actions + (size_t)past * h.action_dim, h.horizon - past, h.action_dim, chunk);
    return TSP_OK;
}

void tsp_free(tsp_policy* policy) {
    if (!policy) return;
    void* const owned[] = {policy->bytes, policy->layers, policy->folds, policy->mask, policy->scratch, policy->noise,
                           policy->features, policy->actions, policy->logits, policy->order, policy->text, policy};
    for (void* memory : owned) free(memory);
}
}
