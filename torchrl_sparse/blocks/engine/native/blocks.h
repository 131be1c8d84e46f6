// The feed-forward network; and a block, computed or reused: what it adds to the residual stream.
// Writes to b.x, b.hidden, and the slots of b.latest.
// Part of level.h, once for each instruction set: may call only what level.h includes before it.

// This thread's columns of hidden = activation(x * up).
inline void Query::expand(const float* x, int ldx, int n, const Matrix& up, Activation kind) const {
    const Range columns = share(up);
    product(x, ldx, n, up, columns, b.hidden, b.ldh);
    for (int t = 0; t < n; t++)
        for (int j = columns.first; j < columns.last; j += VECTOR) {
            float* const p = b.hidden + t * b.ldh + j;
            store(p, kind == GELU ? gelu(load(p)) : mish(load(p)));
        }
}

inline void Query::feed_forward(const Layer& layer, float* d) const {
    expand(b.y, b.ld, m.horizon, layer.up, GELU);
    who.barrier();
    product(b.hidden, b.ldh, m.horizon, layer.down, share(layer.down), d, b.ld);
}

// x += what a block adds. `read`: whether outputs of blocks have been reused since the block before.
inline void Query::compute(int step, int block, bool read) const {
    float* const d = b.latest + (size_t)(block % slots) * m.horizon * b.ld;
    const int index = block / 3, kind = block % 3;
    if (kind == 0) fetch(step, index);
    normalise(kind == 1 ? rows : Range{0, m.horizon});
    if (kind == 0) self_attention(m.layer[index], d);
    if (kind == 1) cross_attention(step, index, read, d);
    if (kind == 2) feed_forward(m.layer[index], d);
    who.barrier();
    for (int i = 0; i < m.horizon * b.ld; i += VECTOR) store(b.x + i, load(b.x + i) + load(d + i));
}

// to [horizon, width] = from + what the blocks first .. last-1 add, in one pass.
inline void Query::reuse(const float* from, int ld_from, float* to, int ld_to, int first, int last) const {
    const bool shared = shares_slots();  // a slot counts as often as its blocks occur
    const int begin = shared ? 0 : first, end = shared ? slots : last;
    for (int t = 0; t < m.horizon; t++)
        for (int j = 0; j < b.width; j += VECTOR) {
            V total = load(from + t * ld_from + j);
            for (int s = begin; s < end; s++) {
                const int before = slots - 1 - s;
                const float times = shared ? (last + before) / slots - (first + before) / slots : 1;
                total += load(b.latest + ((size_t)s * m.horizon + t) * b.ld + j) * times;
            }
            store(to + t * ld_to + j, total);
        }
}
