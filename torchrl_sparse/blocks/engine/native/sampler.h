// The denoising loop: the observations' encoder, the sampler's steps, and the entry points of an instruction set.
// Writes to b.sample, b.eps, b.cleans, b.constant and b.token, and the actions.
// Part of level.h, once for each instruction set: may call only what level.h includes before it.

// Encodes the observations and folds them into the cross-attention of every layer.
inline void Query::encode(const float* cond) const {
    const int n = m.obs_steps;
    expand(cond, m.cond_dim, n, m.encode_up, MISH);
    who.barrier();
    product(b.hidden, b.ldh, n, m.encode_down, share(m.encode_down), b.token, b.ld);
    who.barrier();
    const Range layers = share(m.layers);
    for (int i = layers.first; i < layers.last; i++) fold(i);
    who.barrier();
}

// Predicts the noise from the residual stream and takes the sampler's step, with MEMORY of earlier clean predictions,
// GUIDED to actions.
template <bool MEMORY, bool GUIDED>
inline void Query::advance(int step, const float* noise, const Guide& guide) const {
    normalise({0, m.horizon});
    const int lda = stride(m.action_dim);
    whole_product(b.y, b.ld, m.horizon, m.head, b.eps, lda);
    const float* c = m.coefficients + COEFFICIENTS * step;
    float* const previous = b.cleans;
    float* const earlier = previous + m.horizon * lda;
    for (int t = 0; t < m.horizon; t++)
        for (int j = 0; j < m.action_dim; j++) {
            float& sample = b.sample[t * lda + j];
            const float eps = b.eps[t * lda + j];
            float clean = (sample - c[0] * eps) / c[1];
            clean = clean > m.clip ? m.clip : clean < -m.clip ? -m.clip : clean;
            if constexpr (GUIDED) clean += guide.pull[t] * (guide.actions[t * m.action_dim + j] - clean);
            float next = c[2] * clean + c[3] * sample + c[4] * eps;
            if constexpr (MEMORY) {
                const int at = t * lda + j;
                next += c[5] * previous[at] + c[6] * earlier[at];
                earlier[at] = previous[at];
                previous[at] = clean;
            }
            sample = noise ? next + c[7] * noise[t * m.action_dim + j] : next;
        }
}

template <bool GUIDED>
inline void Query::finish(int step, const float* noise, const Guide& guide) const {
    m.history ? advance<true, GUIDED>(step, noise, guide) : advance<false, GUIDED>(step, noise, guide);
}

inline void Query::run(const uint8_t* pruned, const float* noise, const float* cond, const Guide& guide, float* actions) const {
    const int lda = stride(m.action_dim), size = m.horizon * m.action_dim, blocks = 3 * m.layers;
    encode(cond);
    Matrix constant = m.embed;  // of a step without a computed block: what all of them add goes into the bias
    constant.bias = b.constant;
    bool known = false;  // whether b.constant is of the latest outputs
    bool read = false;
    for (int t = 0; t < m.horizon; t++) copy(noise + t * m.action_dim, m.action_dim, b.sample + t * lda);
    if (m.history)
        for (int i = 0; i < 2 * m.horizon * lda; i++) b.cleans[i] = 0;
    for (int step = 0; step < m.steps; step++, pruned += blocks) {
        const bool empty = run_end(pruned, 0, blocks) == blocks;
        if (empty && !known) reuse(m.embed.bias, b.width, b.constant, b.width, 0, blocks);
        known = empty;
        read = read || empty;
        whole_product(b.sample, lda, m.horizon, empty ? constant : m.embed, b.x, b.ld);
        for (int block = empty ? blocks : 0, end; block < blocks; block = end + 1) {
            end = run_end(pruned, block, blocks);
            if (end > block) reuse(b.x, b.ld, b.x, b.ld, block, end);
            read = read || end > block;
            if (end == blocks) break;
            compute(step, end, read), read = false;
        }
        const float* const gaussian = step + 1 < m.steps ? noise + (size_t)(step + 1) * size : nullptr;
        guide.actions ? finish<true>(step, gaussian, guide) : finish<false>(step, gaussian, guide);
    }
    for (int t = rows.first; t < rows.last; t++) copy(b.sample + t * lda, m.action_dim, actions + t * m.action_dim);
}

// The first block from `block` on that is computed: pruned ones before it add a sum of what is there already.
inline int Query::run_end(const uint8_t* pruned, int block, int blocks) {
    while (block < blocks && pruned[block]) block++;
    return block;
}

void denoise(const Model& m, const Member& who, const uint8_t* pruned, int slots, const float* noise, const float* cond,
             const Guide& guide, float* actions, float* own, float* shared) {
    Query(m, slots, who, own, shared).run(pruned, noise, cond, guide, actions);
}

void run_blocks(const Model& m, const Member& who, int kind, float* own, float* shared) {
    const Query query(m, 3, who, own, shared);
    for (int layer = 0; layer < m.layers; layer++) query.compute(0, 3 * layer + kind, false);
}
