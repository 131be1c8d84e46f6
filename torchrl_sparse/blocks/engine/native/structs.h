// The structures that Python fills and the engine reads, and what a query is drawn to.

#pragma once

#include <cstdint>

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
