// Self- and cross-attention of a query, and the folding of its observations into the latter. Writes to
// its result, b.scores, b.qkv and b.mixed; folding to b.kv, b.key, b.value and b.key_bias.
// Part of level.h, once for each instruction set: may call only what level.h includes before it.

// Of this thread's rows, and of what else their vectors hold.
inline void Query::softmax(int n) const {
    for (int lane = rows.first * m.heads / VECTOR * VECTOR; lane < rows.last * m.heads; lane += VECTOR) {
        float* const s = b.scores + lane;
        V most = load(s), total{};
        for (int i = 1; i < n; i++) {
            const V v = load(s + (size_t)i * b.lanes);
            most = v > most ? v : most;
        }
        for (int i = 0; i < n; i++) {
            const V e = exponential(load(s + (size_t)i * b.lanes) - most);
            store(s + (size_t)i * b.lanes, e);
            total += e;
        }
        const V scale = 1.f / total;
        for (int i = 0; i < n; i++) store(s + (size_t)i * b.lanes, load(s + (size_t)i * b.lanes) * scale);
    }
}

inline void Query::self_attention(const Layer& layer, float* d) const {
    const int part = padded(b.inner), ldq = stride(3 * part), ldm = stride(b.inner), head = b.head;
    product(b.y, b.ld, m.horizon, layer.qkv, share(layer.qkv), b.qkv, ldq);
    who.barrier();
    const float *keys = b.qkv + part, *values = keys + part;
    for (int t = rows.first; t < rows.last; t++)
        for (int h = 0; h < m.heads; h++)
            for (int s = 0; s < m.horizon; s++)
                score(s, t, h) = hidden(s, t) ? UNSEEN : dot(b.qkv + t * ldq + h * head, keys + s * ldq + h * head, head);
    softmax(m.horizon);
    for (int t = rows.first; t < rows.last; t++)
        for (int h = 0; h < m.heads; h++)
            for (int j = h * head; j < h * head + head; j += VECTOR) {
                V total{};
                for (int s = 0; s < m.horizon && !hidden(s, t); s++) total += load(values + s * ldq + j) * score(s, t, h);
                store(b.mixed + t * ldm + j, total);
            }
    who.barrier();
    product(b.mixed, ldm, m.horizon, layer.out, share(layer.out), d, b.ld);
}

// What cross-attention reads of a step that no other reads. Weights have driven it out of the caches.
inline void Query::fetch(int step, int index) const {
    const size_t first = ((size_t)step * m.layers + index) * m.heads * b.width;
    for (int j = 0; j < m.heads * b.width; j += 16) {
        __builtin_prefetch(m.time_key + first + j, 0, 2);
        __builtin_prefetch(m.time_value + first + j, 0, 2);
    }
}

// Scores and outputs are products with the folded memory: 1 + obs_steps vectors for each head and side.
inline void Query::cross_attention(int step, int index, bool read, float* d) const {
    // Token 0 is the denoising step, which all actions see; token s the observation s - 1.
    const size_t time = ((size_t)step * m.layers + index) * m.heads;
    auto token = [&](int s, const float* of_time, const float* of_observations, int size) {
        return s ? of_observations + memory(index, s - 1) * size : of_time + time * size;
    };
    for (int s = 0; s <= m.obs_steps; s++) {
        const float* const keys = token(s, m.time_key, b.key, b.width);
        const float* const biases = token(s, m.time_bias, b.key_bias, 1);
        for (int t = rows.first; t < rows.last; t++)
            for (int h = 0; h < m.heads; h++)
                score(s, t, h) = hidden(s - 1, t)
                    ? UNSEEN : dot(b.y + t * b.ld, keys + (size_t)h * b.width, b.width) + biases[h];
    }
    softmax(1 + m.obs_steps);
    if (read || shares_slots()) who.barrier();  // until all have read what a cross-attention left in the same slot
    for (int t = rows.first; t < rows.last; t++)
        for (int j = 0; j < b.width; j += VECTOR) {
            V total = load(m.layer[index].cross_bias + j);
            for (int s = 0; s <= m.obs_steps && !hidden(s - 1, t); s++) {
                const float* const values = token(s, m.time_value, b.value, b.width) + j;
                for (int h = 0; h < m.heads; h++) total += load(values + (size_t)h * b.width) * score(s, t, h);
            }
            store(d + t * b.ld + j, total);
        }
}

inline void Query::fold(int index) const {
    const int n = m.obs_steps, part = padded(b.inner), ldk = stride(2 * part);
    const Layer& layer = m.layer[index];
    const size_t first = memory(index, 0);
    whole_product(b.token, b.ld, n, layer.kv, b.kv, ldk);
    for (int side = 0; side < 2; side++)
        for (int h = 0; h < m.heads; h++)
            whole_product(b.kv + side * part + h * b.head, ldk, n, layer.fold[side * m.heads + h],
                          (side ? b.value : b.key) + (first + h) * b.width, m.heads * b.width);
    for (int o = 0; o < n; o++)
        for (int h = 0; h < m.heads; h++)
            b.key_bias[first + o * m.heads + h] = dot(b.kv + o * ldk + h * b.head, layer.query_bias + h * b.head, b.head);
}
