/* Loads every truncation of a file, and the file with every bit turned over, as it then is and with the checksum made good; what
 * loads has to answer. The second argument is the step between bytes behind the header; sanitizers say if anything else happens. */

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "tsp.h"

enum { HEADER = 128, CHECKSUM = 12, CHECKED_FROM = 16 };

static uint32_t table[256];

static uint32_t crc32(const unsigned char* bytes, size_t n) {
    uint32_t crc = ~0u;
    for (size_t i = 0; i < n; i++) crc = crc >> 8 ^ table[(crc ^ bytes[i]) & 255];
    return ~crc;
}

/* Returns 1 if the bytes are taken for a policy. */
static int try(const unsigned char* bytes, size_t size) {
    char error[128] = "";
    tsp_policy* policy = tsp_load_memory(bytes, size, error, sizeof error);
    if (!policy) return strlen(error) > 0 ? 0 : (puts("refused without a word"), exit(1), 0);
    const tsp_info info = tsp_describe(policy);
    const size_t states = (size_t)info.n_obs_steps * info.state_dim, actions = (size_t)info.chunk_steps * info.action_dim;
    float *history = calloc(states, sizeof(float)), *chunk = calloc(actions, sizeof(float));
    if (!history || !chunk || strlen(info.description) > size) exit(1);
    tsp_query(policy, history, 7, chunk);
    free(history);
    free(chunk);
    tsp_free(policy);
    return 1;
}

int main(int argc, char** argv) {
    static unsigned char bytes[1 << 20];
    if (argc != 3) return 2;
    FILE* file = fopen(argv[1], "rb");
    const size_t size = file ? fread(bytes, 1, sizeof bytes, file) : 0, step = strtoul(argv[2], NULL, 10);
    if (file) fclose(file);
    for (uint32_t i = 0; i < 256; i++) {
        table[i] = i;
        for (int bit = 0; bit < 8; bit++) table[i] = table[i] >> 1 ^ (table[i] & 1 ? 0xEDB88320u : 0);
    }
    if (!try(bytes, size)) return puts("the file itself is refused"), 1;
    int taken = 0, harmless = 0;
    for (size_t n = 0; n < size; n += n < HEADER ? 1 : step) taken += try(bytes, n);
    for (size_t i = 0; i < size; i += i < HEADER ? 1 : step)
        for (int bit = 0; bit < 8; bit++) {
            bytes[i] ^= 1 << bit;
            taken += try(bytes, size);
            if (i >= CHECKED_FROM) {
                unsigned char before[4];
                memcpy(before, bytes + CHECKSUM, 4);
                const uint32_t sum = crc32(bytes + CHECKED_FROM, size - CHECKED_FROM);
                memcpy(bytes + CHECKSUM, &sum, 4);
                harmless += try(bytes, size);
                memcpy(bytes + CHECKSUM, before, 4);
            }
            bytes[i] ^= 1 << bit;
        }
    printf("%d taken, %d harmless\n", taken, harmless);
    return taken != 0;
}
