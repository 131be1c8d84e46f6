// The memory of a query and the paddings of its rows, once for all instruction sets.

#pragma once

#include <cstddef>
#include <cstdint>

#include "structs.h"

// What the clean predictions of one query are drawn to; null where they are not.
struct Guide {
    const float* actions;  // [horizon][action_dim]
    const float* pull;     // [horizon], 0 to 1
};

namespace {

enum Activation { GELU, MISH };
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
        : width(padded(m.width)), ld(stride(m.width)), head((m.width / m.heads + HEAD - 1) / HEAD * HEAD),
          inner(m.heads * head), ldh(stride(4 * m.width)), lanes(padded(m.horizon * m.heads)) {
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
