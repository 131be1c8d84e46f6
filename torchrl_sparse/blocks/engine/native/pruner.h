// The MLP of a learned planner, see pruner.py.
// Part of level.h, once for each instruction set: may call only what level.h includes before it.

// One observation's logits = relu(relu(cells + observation * obs) * middle) . last, a group of cells after the other.
void prune(const Pruner& p, const Member& who, const float* observation, float* logits, uint8_t* mask) {
    // With so many rows, a tile holds two vectors of each in registers: half the loads of one with MAX_ROWS.
    constexpr int GROUP = REGISTERS == 32 ? 12 : MAX_ROWS;
    constexpr int ld = stride(MAX_HIDDEN);
    alignas(64) float added[ld], x[GROUP * ld], y[GROUP * ld];
    const int width = p.middle.columns;
    multiply<float>(observation, 0, 1, p.obs, {0, p.obs.columns}, added, 0);
    for (int first = who.rank * GROUP; first < p.count; first += who.size * GROUP) {
        const int n = p.count - first < GROUP ? p.count - first : GROUP;
        for (int c = 0; c < n; c++)
            for (int j = 0; j < width; j += VECTOR) {
                const float* const cell = p.cells + (size_t)(first + c) * width + j;
                // A policy's weights have driven the cells out of the cache.
                __builtin_prefetch(cell + (size_t)2 * who.size * GROUP * width);
                store(x + c * ld + j, relu(load(cell) + load(added + j)));
            }
        multiply<float>(x, ld, n, p.middle, {0, width}, y, ld);
        for (int c = 0; c < n; c++) {
            V total{};
            for (int j = 0; j < width; j += VECTOR) total += relu(load(y + c * ld + j)) * load(p.last + j);
            const float logit = p.bias + sum(total);
            if (logits) logits[first + c] = logit;
            if (mask) mask[first + c] = logit > 0.f && first + c >= p.first;
        }
    }
}
