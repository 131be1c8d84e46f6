/* Answers queries of an exported policy: a seed and a history of states on each line of the input, a chunk of actions on each
 * of the output. Numbers of states and actions are hexadecimal floats, which lose nothing. */

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>

#include "tsp.h"

int main(int argc, char** argv) {
    char error[512];
    tsp_policy* policy = argc == 2 ? tsp_load(argv[1], error, sizeof error) : NULL;
    if (!policy) {
        fprintf(stderr, "%s\n", argc == 2 ? error : "usage: example POLICY.tsp < queries");
        return 2;
    }
    const tsp_info info = tsp_describe(policy);
    const int states = info.n_obs_steps * info.state_dim, actions = info.chunk_steps * info.action_dim;
    float *history = calloc(states, sizeof(float)), *chunk = calloc(actions, sizeof(float));
    uint64_t seed;
    int status = history && chunk ? 0 : 2;
    while (!status && scanf("%" SCNu64, &seed) == 1) {
        for (int i = 0; i < states; i++)
            if (scanf("%f", &history[i]) != 1) status = 2;
        if (!status) status = tsp_query(policy, history, seed, chunk);
        for (int i = 0; !status && i < actions; i++) printf("%a ", chunk[i]);
        puts("");
    }
    free(history);
    free(chunk);
    tsp_free(policy);
    return status;
}
