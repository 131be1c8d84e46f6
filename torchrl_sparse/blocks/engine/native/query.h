// One query, or one thread's share of it: what the files named below define of it. Reads the model, writes to its buffers.
// Part of level.h, once for each instruction set: may call only what level.h includes before it.

struct Query {
    const Model& m;
    const Buffers b;
    const int slots;
    const Member who;
    const Range rows;  // of the horizon, this thread's

    Query(const Model& m, int slots, const Member& who, float* own, float* shared)
        : m(m), b(m, slots, own, shared), slots(slots), who(who), rows(share(m.horizon)) {}

    // This thread's of n items.
    Range share(int n) const { return {n * who.rank / who.size, n * (who.rank + 1) / who.size}; }

    // This thread's columns of a product.
    Range share(const Matrix& a) const {
        const Range panels = share(a.columns / PANEL);
        return {panels.first * PANEL, panels.last * PANEL};
    }

    // Whether several blocks leave their outputs in one slot.
    bool shares_slots() const { return slots < 3 * m.layers; }

    // Whether action t may not look at action s or, in the memory, at token s.
    bool hidden(int s, int t) const { return m.causal && s > t; }

    // Scores lie as [key][lane], a lane being one head of one query: n keys are summed up without leaving the vector.
    float& score(int key, int t, int h) const { return b.scores[(size_t)key * b.lanes + t * m.heads + h]; }

    // Index of the first folded vector of a layer and an observation.
    size_t memory(int layer, int observation) const { return ((size_t)layer * m.obs_steps + observation) * m.heads; }

    static void copy(const float* from, size_t n, float* to) {
        for (size_t i = 0; i < n; i++) to[i] = from[i];
    }

    // products.h
    void product(const float* x, int ldx, int n, const Matrix& a, Range columns, float* y, int ldy) const;
    void whole_product(const float* x, int ldx, int n, const Matrix& a, float* y, int ldy) const;
    void integer_product(const float* x, int ldx, int n, const Matrix& a, Range columns, float* y, int ldy) const;
    static void round(const float* x, int n, float* pairs);
    static void quantise(const float* x, int n, uint8_t* bytes, float* grid);
    void normalise(Range rows) const;

    // attention.h
    void softmax(int n) const;
    void self_attention(const Layer& layer, float* d) const;
    void fetch(int step, int index) const;
    void cross_attention(int step, int index, bool read, float* d) const;
    void fold(int index) const;

    // blocks.h
    void expand(const float* x, int ldx, int n, const Matrix& up, Activation kind) const;
    void feed_forward(const Layer& layer, float* d) const;
    void compute(int step, int block, bool read) const;
    void reuse(const float* from, int ld_from, float* to, int ld_to, int first, int last) const;

    // sampler.h
    void encode(const float* cond) const;
    template <bool MEMORY, bool GUIDED>
    void advance(int step, const float* noise, const Guide& guide) const;
    template <bool GUIDED>
    void finish(int step, const float* noise, const Guide& guide) const;
    void run(const uint8_t* pruned, const float* noise, const float* cond, const Guide& guide, float* actions) const;
    static int run_end(const uint8_t* pruned, int block, int blocks);
};
