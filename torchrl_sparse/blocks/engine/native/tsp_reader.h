// Reads an exported policy that lies in memory. Writes to the policy it makes and to the caller's message, nothing else.
//
// A file holds no offset and no address. It is a header of sizes, and arrays in a fixed order whose lengths follow from
// these sizes, each on a cache line of its own; together they fill the file. So all that has to be checked are the sizes, each
// within its bounds, and the end.

#pragma once

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "denoise.h"
#include "units.h"

namespace {

constexpr size_t MOST_SCRATCH = (size_t)1 << 30;

// The caller's memory for one line that says what is wrong, from where the next part goes.
struct Message {
    char* text;
    size_t size;

    // Appends as much as fits. Returns false, as those do who have something to write.
    bool write(const char* format, ...) __attribute__((format(printf, 2, 3))) {
        if (!size) return false;
        va_list arguments;
        va_start(arguments, format);
        const int wanted = vsnprintf(text, size, format, arguments);
        va_end(arguments);
        const size_t written = wanted < 0 ? 0 : (size_t)wanted < size ? (size_t)wanted : size - 1;
        text += written, size -= written;
        return false;
    }
};

uint32_t crc32(const uint8_t* bytes, size_t n) {
    uint32_t table[256];
    for (uint32_t i = 0; i < 256; i++) {
        table[i] = i;
        for (int bit = 0; bit < 8; bit++) table[i] = table[i] >> 1 ^ (table[i] & 1 ? 0xEDB88320u : 0);
    }
    uint32_t crc = ~0u;
    for (size_t i = 0; i < n; i++) crc = crc >> 8 ^ table[(crc ^ bytes[i]) & 255];
    return ~crc;
}

size_t lines(size_t bytes) { return (bytes + CACHE_LINE - 1) / CACHE_LINE * CACHE_LINE; }

void* on_line(size_t bytes) {
    void* memory = nullptr;
    return posix_memalign(&memory, CACHE_LINE, bytes ? lines(bytes) : CACHE_LINE) ? nullptr : memory;
}

}  // namespace

struct tsp_policy {
    Header h;
    Model model;
    Pruner pruner;
    int32_t level, cells;  // of a mask
    uint8_t* bytes;        // the file
    Layer* layers;
    Matrix* folds;
    uint8_t* mask;
    const char* description;
    Units units;
    float *scratch, *noise, *features, *actions, *logits;
    int32_t* order;
    char* text;  // ends with a zero, which the file's need not
};

namespace {

// Reads a file that lies in memory from front to back. After the first fault, what it returns means nothing.
class Reader {
  public:
    Reader(tsp_policy& policy, size_t size, Message& message) : p_(policy), size_(size), message_(message) {}

    bool read() { return header() && sizes() && arrays() && memory(); }

  private:
    bool header() {
        Header& h = p_.h;
        if (size_ < sizeof h.magic || memcmp(p_.bytes, TSP_MAGIC, sizeof h.magic))
            return message_.write("expected an exported policy (.tsp)");
        if (size_ < sizeof h) return message_.write("size: expected a header of %zu bytes, got %zu", sizeof h, size_);
        memcpy(&h, p_.bytes, sizeof h);
        if (h.version != TSP_VERSION)
            return message_.write("version: expected %d, got %u; export the policy again", TSP_VERSION, h.version);
        if (h.size != size_)
            return message_.write("size: expected %llu bytes, got %llu", (unsigned long long)h.size, (unsigned long long)size_);
        const uint32_t sum = crc32(p_.bytes + TSP_CHECKED_FROM, size_ - TSP_CHECKED_FROM);
        return sum == h.checksum || message_.write("checksum: expected %08x, got %08x; the file is damaged", h.checksum, sum);
    }

    bool within(const char* name, int32_t value, int32_t least, int32_t most) {
        return (value >= least && value <= most) || message_.write("%s: expected %d to %d, got %d", name, least, most, value);
    }

    // Far beyond any use, and small enough that no size of an array overflows.
    bool sizes() {
        const Header& h = p_.h;
        const bool ok = within("horizon", h.horizon, 1, 1024) && within("width", h.width, 1, 8192) &&
                        within("layers", h.layers, 1, 256) && within("heads", h.heads, 1, h.width) &&
                        within("obs_steps", h.obs_steps, 1, h.horizon < MAX_OBS_STEPS ? h.horizon : MAX_OBS_STEPS) &&
                        within("action_dim", h.action_dim, 1, 4096) && within("cond_dim", h.cond_dim, 1, 1 << 16) &&
                        within("steps", h.steps, 1, 10000) && within("causal", h.causal, 0, 1) &&
                        within("history", h.history, 0, 2) && within("weights", h.weights, F32, BF16) &&
                        within("slots", h.slots, 1, 3 * h.layers) && within("plan", h.plan, DENSE, PRUNER) &&
                        within("hidden", h.hidden, h.plan == PRUNER, MAX_HIDDEN) && within("rated", h.rated, 0, 1) &&
                        within("description", h.description, 0, 1 << 20);
        if (!ok) return false;
        if (h.width % h.heads) return message_.write("heads: expected a divisor of width %d, got %d", h.width, h.heads);
        if (h.slots != 1 && h.slots != 3 && h.slots != 3 * h.layers)
            return message_.write("slots: expected 1, 3 or %d, got %d", 3 * h.layers, h.slots);
        p_.cells = h.steps * 3 * h.layers;
        return !h.rated || within("pruned", h.pruned, 1, p_.cells - 3 * h.layers - 1);
    }

    template <class T>
    const T* take(size_t count) {
        const size_t bytes = lines(count * sizeof(T)), at = at_;
        missing_ = missing_ || bytes > size_ - at;
        if (missing_) return nullptr;
        at_ += bytes;
        return (const T*)(p_.bytes + at);
    }

    Matrix matrix(int32_t rows, int32_t columns, int32_t type, int32_t biases = 1) {
        Matrix a{};
        a.type = type;
        a.rows = type == BF16 ? (rows + 1) / 2 : rows;
        a.columns = padded(columns);
        a.bias_stride = biases > 1 ? a.columns : 0;
        a.weight = take<uint8_t>((size_t)a.rows * a.columns * (type == F16 ? 2 : 4));
        a.bias = take<float>((size_t)biases * a.columns);
        return a;
    }

    bool arrays() {
        const Header& h = p_.h;
        Model& m = p_.model;
        const int32_t head = (h.width / h.heads + HEAD - 1) / HEAD * HEAD, inner = h.heads * head, part = padded(inner);
        m.horizon = h.horizon, m.width = h.width, m.layers = h.layers, m.heads = h.heads, m.obs_steps = h.obs_steps;
        m.action_dim = h.action_dim, m.cond_dim = h.cond_dim, m.steps = h.steps, m.causal = h.causal;
        m.history = h.history, m.clip = h.clip;
        p_.layers = (Layer*)calloc(h.layers, sizeof(Layer));
        p_.folds = (Matrix*)calloc((size_t)h.layers * 2 * h.heads, sizeof(Matrix));
        if (!p_.layers || !p_.folds) return message_.write("expected memory for the policy, there is none");
        m.layer = p_.layers;
        at_ = lines(sizeof(Header));
        p_.description = take<char>(h.description);
        p_.units.state_scale = take<float>(h.cond_dim);
        p_.units.state_offset = take<float>(h.cond_dim);
        p_.units.action_scale = take<float>(h.action_dim);
        p_.units.action_offset = take<float>(h.action_dim);
        m.embed = matrix(h.action_dim, h.width, F32, h.horizon);
        m.head = matrix(h.width, h.action_dim, F32);
        m.encode_up = matrix(h.cond_dim, 4 * h.width, F32, h.obs_steps);
        m.encode_down = matrix(4 * h.width, h.width, h.weights);
        const size_t vectors = (size_t)h.steps * h.layers * h.heads;
        m.time_key = take<float>(vectors * padded(h.width));
        m.time_value = take<float>(vectors * padded(h.width));
        m.time_bias = take<float>(vectors);
        m.coefficients = take<float>((size_t)h.steps * COEFFICIENTS);
        m.valid = take<float>(padded(h.width));
        for (int32_t i = 0; i < h.layers && !missing_; i++) {
            Layer& layer = p_.layers[i];
            layer.qkv = matrix(h.width, 3 * part, h.weights);
            layer.out = matrix(inner, h.width, h.weights);
            layer.up = matrix(h.width, 4 * h.width, h.weights);
            layer.down = matrix(4 * h.width, h.width, h.weights);
            layer.kv = matrix(h.width, 2 * part, h.weights);
            Matrix* const folds = p_.folds + (size_t)i * 2 * h.heads;
            for (int32_t j = 0; j < 2 * h.heads; j++) folds[j] = matrix(head, h.width, h.weights);
            layer.fold = folds;
            layer.query_bias = take<float>(inner);
            layer.cross_bias = take<float>(padded(h.width));
        }
        const uint8_t* mask = h.plan == MASK ? take<uint8_t>(p_.cells) : nullptr;
        if (h.plan == PRUNER) {
            p_.pruner.obs = matrix(h.obs_steps * h.cond_dim + h.rated, h.hidden, F32);
            p_.pruner.middle = matrix(h.hidden, h.hidden, F32);
            p_.pruner.cells = take<float>((size_t)p_.cells * padded(h.hidden));
            p_.pruner.last = take<float>(padded(h.hidden));
            p_.pruner.bias = h.bias;
            p_.pruner.count = p_.cells;
            p_.pruner.first = 3 * h.layers;
        }
        if (missing_ || at_ != size_)
            return message_.write("size: expected the header's arrays to fill %zu bytes, got %s", size_,
                                  missing_ ? "more" : "fewer");
        for (int32_t i = 0; mask && i < 3 * h.layers; i++)
            if (mask[i]) return message_.write("mask: expected a first step that prunes nothing, got block %d", i);
        p_.mask = (uint8_t*)on_line(p_.cells);
        if (!p_.mask) return message_.write("expected memory for the policy, there is none");
        memset(p_.mask, 0, p_.cells);
        if (mask) memcpy(p_.mask, mask, p_.cells);
        return true;
    }

    // Everything that a query writes to, written to once: the system hands out pages when they are.
    bool memory() {
        const Header& h = p_.h;
        const size_t scratch = Buffers(p_.model, h.slots, nullptr, nullptr).size, chunk = (size_t)h.horizon * h.action_dim;
        if (scratch * sizeof(float) > MOST_SCRATCH)
            return message_.write("sizes: expected a query of at most %zu bytes, got %zu", MOST_SCRATCH,
                                  scratch * sizeof(float));
        const bool rated = h.plan == PRUNER && h.rated;
        p_.scratch = floats(scratch);
        p_.noise = floats(h.steps * chunk);
        p_.features = floats((size_t)h.obs_steps * h.cond_dim + 1);
        p_.actions = floats(chunk);
        p_.logits = floats(rated ? p_.cells : 0);
        p_.order = (int32_t*)floats(rated ? p_.cells : 0);
        p_.text = (char*)calloc((size_t)h.description + 1, 1);
        if (!p_.scratch || !p_.noise || !p_.features || !p_.actions || !p_.logits || !p_.order || !p_.text)
            return message_.write("expected memory for a query, there is none");
        memcpy(p_.text, p_.description, h.description);
        p_.features[(size_t)h.obs_steps * h.cond_dim] = h.rate;
        p_.level = levels() - 1;
        return true;
    }

    static float* floats(size_t count) {
        void* const memory = on_line(count * sizeof(float));
        return (float*)(memory ? memset(memory, 0, count * sizeof(float)) : nullptr);
    }

    tsp_policy& p_;
    const size_t size_;
    Message& message_;
    size_t at_ = 0;
    bool missing_ = false;
};

}  // namespace
