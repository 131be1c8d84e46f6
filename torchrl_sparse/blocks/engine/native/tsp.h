/* A policy that a robot runs: one file, written by DiffusionPolicy.export in Python, from a history of states and a seed to a
 * chunk of actions. No Python, no PyTorch, no thread, and no allocation after loading. The same numbers as in Python with
 * `policy.noise = "philox"`, to the last bit, on a CPU with the same instruction set.
 *
 *     char error[256];
 *     tsp_policy* policy = tsp_load("lift.tsp", error, sizeof error);
 *     if (!policy) return fprintf(stderr, "%s\n", error), 1;
 *     const tsp_info info = tsp_describe(policy);
 *     float* chunk = malloc(sizeof(float) * info.chunk_steps * info.action_dim);
 *     tsp_query(policy, history, seed, chunk);
 *     tsp_free(policy);
 *
 * A policy answers one query at a time: load it once for each thread that asks. */

#ifndef TORCHRL_SPARSE_TSP_H
#define TORCHRL_SPARSE_TSP_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef struct tsp_policy tsp_policy;

typedef struct tsp_info {
    int32_t n_obs_steps;     /* states in a history, the oldest first */
    int32_t state_dim;       /* numbers in a state, in the units of the environment */
    int32_t chunk_steps;     /* actions in a chunk, the first for now */
    int32_t action_dim;      /* numbers in an action, in the units of the environment */
    int32_t denoising_steps;
    const char* description; /* JSON in UTF-8: whose policy it is, and the names of what a state is made of where known;
                              * it lives as long as the policy */
} tsp_info;

enum { TSP_OK = 0, TSP_NOT_FINITE = 1 };

/* Reads a file. On failure returns NULL and writes one line that says what was expected and what came into `error`, cut to
 * `error_size` bytes; `error` may be NULL if that is 0. Whatever a file holds, reading and running it is safe: it is data. */
tsp_policy* tsp_load(const char* path, char* error, size_t error_size);

/* The same of bytes in memory, which are copied. */
tsp_policy* tsp_load_memory(const void* bytes, size_t size, char* error, size_t error_size);

tsp_info tsp_describe(const tsp_policy* policy);

/* history [n_obs_steps][state_dim] -> chunk [chunk_steps][action_dim]. The seed, below 2^63, decides all noise. Returns TSP_OK, or
 * TSP_NOT_FINITE if the history holds an infinity or a NaN; chunk is then left alone. */
int tsp_query(tsp_policy* policy, const float* history, uint64_t seed, float* chunk);

/* NULL is allowed. */
void tsp_free(tsp_policy* policy);

#ifdef __cplusplus
}
#endif

#endif
