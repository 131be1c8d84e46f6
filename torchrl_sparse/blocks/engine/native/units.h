// Between the units of the environment and those of the policy, rounded as PyTorch does it in normalize.py.

#pragma once

#include <stddef.h>

#include "structs.h"

// normalised = state * scale + offset, [rows][dim]. Returns whether all of the states are finite.
inline bool normalise(const Units& units, const float* states, size_t rows, size_t dim, float* normalised) {
    bool finite = true;
    for (size_t i = 0; i < rows * dim; i++) {
        const volatile float scaled = states[i] * units.state_scale[i % dim];  // rounded before the sum
        finite = finite && states[i] - states[i] == 0;
        normalised[i] = scaled + units.state_offset[i % dim];
    }
    return finite;
}

// actions = (normalised - offset) / scale, [rows][dim].
inline void unnormalise(const Units& units, const float* normalised, size_t rows, size_t dim, float* actions) {
    for (size_t i = 0; i < rows * dim; i++)
        actions[i] = (normalised[i] - units.action_offset[i % dim]) / units.action_scale[i % dim];
}
