// The C interface of tsp.h: reads what tsp.py writes, and runs it in the kernels of denoise.h.
//
// A file holds no offset and no address. It is a header of sizes, and arrays in a fixed order whose lengths follow from
// these sizes, each on a cache line of its own; together they fill the file. So all that has to be checked are the sizes, each
// within its bounds, and the end. Neither exceptions nor the library of C++ are used.

#include "tsp.h"

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "denoise.h"
#include "philox.h"
#include "units.h"

namespace {

constexpr char MAGIC[8] = {'T', 'S', 'P', 'O', 'L', 'I', 'C', 'Y'};
constexpr uint32_t VERSION = 1;
constexpr size_t LINE = 64, CHECKED_FROM = 16, MOST_SCRATCH = (size_t)1 << 30;

enum Plan : int32_t { DENSE, MASK, PRUNER };

// tsp.py writes the same fields. Little-endian, and padded to whole lines.
struct Header {
    char magic[8];
    uint32_t version, checksum;  // CRC-32 of everything behind it
    uint64_t size;               // of the file
    int32_t horizon, width, layers, heads, obs_steps, action_dim, cond_dim, steps, causal, history;
    int32_t weights;             // Type of the large matrices
    int32_t slots;               // see Buffers::latest
    int32_t plan, hidden;        // of a pruner
    int32_t rated, pruned;       // of a pruner: whether the rate is an input; if it is, the cells to prune
    int32_t description;         // bytes
    float clip, bias, rate;      // the last two of a pruner
};
static_assert(sizeof(Header) == 104, "padding");

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

size_t lines(size_t bytes) { return (bytes + LINE - 1) / LINE * LINE; }

void* on_line(size_t bytes) {
    void* memory = nullptr;
    return posix_memalign(&memory, LINE, bytes ? lines(bytes) : LINE) ? nullptr : memory;
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
    Reader(tsp_policy& policy, size_t size, char* error, size_t error_size)
        : p_(policy), size_(size), error_(error), error_size_(error_size) {}

    bool read() { return header() && sizes() && arrays() && memory(); }

    bool fail(const char* format, ...) __attribute__((format(printf, 2, 3))) {
        if (error_size_) {
            va_list arguments;
            va_start(arguments, format);
            vsnprintf(error_, error_size_, format, arguments);
            va_end(arguments);
        }
        return false;
    }

  private:
    bool header() {
        Header& h = p_.h;
        if (size_ < sizeof h || memcmp(p_.bytes, MAGIC, sizeof MAGIC)) return fail("expected an exported policy (.tsp)");
        memcpy(&h, p_.bytes, sizeof h);
        if (h.version != VERSION) return fail("version: expected %u, got %u; export the policy again", VERSION, h.version);
        if (h.size != size_)
            return fail("size: expected %llu bytes, got %llu", (unsigned long long)h.size, (unsigned long long)size_);
        const uint32_t sum = crc32(p_.bytes + CHECKED_FROM, size_ - CHECKED_FROM);
        return sum == h.checksum || fail("checksum: expected %08x, got %08x; the file is damaged", h.checksum, sum);
    }

    bool within(const char* name, int32_t value, int32_t least, int32_t most) {
        return (value >= least && value <= most) || fail("%s: expected %d to %d, got %d", name, least, most, value);
    }

    // Far beyond any use, and small enough that no size of an array overflows.
    bool sizes() {
        const Header& h = p_.h;
        const bool ok = within("horizon", h.horizon, 1, 1024) && within("width", h.width, 1, 8192) &&
                        within("layers", h.layers, 1, 256) && within("heads", h.heads, 1, h.width) &&
                        within("obs_steps", h.obs_steps, 1, h.horizon < 63 ? h.horizon : 63) &&
                        within("action_dim", h.action_dim, 1, 4096) && within("cond_dim", h.cond_dim, 1, 1 << 16) &&
                        within("steps", h.steps, 1, 10000) && within("causal", h.causal, 0, 1) &&
                        within("history", h.history, 0, 2) && within("weights", h.weights, F32, BF16) &&
                        within("slots", h.slots, 1, 3 * h.layers) && within("plan", h.plan, DENSE, PRUNER) &&
                        within("hidden", h.hidden, h.plan == PRUNER, MAX_HIDDEN) && within("rated", h.rated, 0, 1) &&
                        within("description", h.description, 0, 1 << 20);
        if (!ok) return false;
        if (h.width % h.heads) return fail("heads: expected a divisor of width %d, got %d", h.width, h.heads);
        if (h.slots != 1 && h.slots != 3 && h.slots != 3 * h.layers) return fail("slots: got %d", h.slots);
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
        a.type = (Type)type;
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
        const int32_t head = (h.width / h.heads + 15) / 16 * 16, inner = h.heads * head, part = padded(inner);
        m.horizon = h.horizon, m.width = h.width, m.layers = h.layers, m.heads = h.heads, m.obs_steps = h.obs_steps;
        m.action_dim = h.action_dim, m.cond_dim = h.cond_dim, m.steps = h.steps, m.causal = h.causal;
        m.history = h.history, m.clip = h.clip;
        p_.layers = (Layer*)calloc(h.layers, sizeof(Layer));
        p_.folds = (Matrix*)calloc((size_t)h.layers * 2 * h.heads, sizeof(Matrix));
        if (!p_.layers || !p_.folds) return fail("expected memory for the policy, there is none");
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
        m.coefficients = take<float>((size_t)h.steps * 8);
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
        if (missing_ || at_ != size_) return fail("size: expected the arrays of these sizes to fill %zu bytes", size_);
        for (int32_t i = 0; mask && i < 3 * h.layers; i++)
            if (mask[i]) return fail("mask: expected a first step that prunes nothing");
        p_.mask = (uint8_t*)on_line(p_.cells);
        if (!p_.mask) return fail("expected memory for the policy, there is none");
        memset(p_.mask, 0, p_.cells);
        if (mask) memcpy(p_.mask, mask, p_.cells);
        return true;
    }

    // Everything that a query writes to, written to once: the system hands out pages when they are.
    bool memory() {
        const Header& h = p_.h;
        const size_t scratch = Buffers(p_.model, h.slots, nullptr, nullptr).size, chunk = (size_t)h.horizon * h.action_dim;
        if (scratch * sizeof(float) > MOST_SCRATCH) return fail("sizes: expected a query of at most 1 GiB");
        const bool rated = h.plan == PRUNER && h.rated;
        p_.scratch = floats(scratch);
        p_.noise = floats(h.steps * chunk);
        p_.features = floats((size_t)h.obs_steps * h.cond_dim + 1);
        p_.actions = floats(chunk);
        p_.logits = floats(rated ? p_.cells : 0);
        p_.order = (int32_t*)floats(rated ? p_.cells : 0);
        p_.text = (char*)calloc((size_t)h.description + 1, 1);
        if (!p_.scratch || !p_.noise || !p_.features || !p_.actions || !p_.logits || !p_.order || !p_.text)
            return fail("expected memory for a query, there is none");
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
    char* const error_;
    const size_t error_size_;
    size_t at_ = 0;
    bool missing_ = false;
};

tsp_policy* adopt(uint8_t* bytes, size_t size, char* error, size_t error_size) {
    tsp_policy* const policy = (tsp_policy*)calloc(1, sizeof(tsp_policy));
    if (!policy) return free(bytes), nullptr;
    policy->bytes = bytes;
    if (Reader(*policy, size, error, error_size).read()) return policy;
    return tsp_free(policy), nullptr;
}

// As numbers that compare like the floats, and so that a NaN has a place among them.
int32_t ordered(float value) {
    int32_t bits;
    memcpy(&bits, &value, sizeof bits);
    return bits >= 0 ? bits : (int32_t)(0x80000000u - (uint32_t)bits);
}

float unordered(int32_t key) {
    const int32_t bits = key >= 0 ? key : (int32_t)(0x80000000u - (uint32_t)key);
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

// The value that would be number k from the largest on, of n keys, which are moved about (Hoare's selection).
int32_t select(int32_t* keys, int32_t n, int32_t k) {
    for (int32_t low = 0, high = n - 1; low < high;) {
        const int32_t pivot = keys[low + (high - low) / 2];
        int32_t i = low, j = high;
        while (i <= j) {
            while (keys[i] > pivot) i++;
            while (keys[j] < pivot) j--;
            if (i > j) break;
            const int32_t swapped = keys[i];
            keys[i++] = keys[j];
            keys[j--] = swapped;
        }
        if (k <= j) high = j;
        else if (k >= i) low = i;
        else break;
    }
    return keys[k];
}

void decide(tsp_policy& p) {
    const Pruner& pruner = p.pruner;
    if (!p.h.rated) return LEVELS[p.level].prune(pruner, Member{}, p.features, nullptr, p.mask);
    LEVELS[p.level].prune(pruner, Member{}, p.features, p.logits, nullptr);
    const int32_t n = p.cells - pruner.first;
    for (int32_t i = 0; i < n; i++) p.order[i] = ordered(p.logits[pruner.first + i]);
    const float last = unordered(select(p.order, n, p.h.pruned - 1)), next = unordered(select(p.order, n, p.h.pruned));
    const float threshold = (last + next) / 2;
    for (int32_t i = pruner.first; i < p.cells; i++) p.mask[i] = p.logits[i] > threshold;
}

}  // namespace

extern "C" {

tsp_policy* tsp_load(const char* path, char* error, size_t error_size) {
    FILE* const file = fopen(path, "rb");
    if (!file) {
        if (error_size) snprintf(error, error_size, "%s: expected a file that can be read", path);
        return nullptr;
    }
    tsp_policy* policy = nullptr;
    const long size = fseek(file, 0, SEEK_END) ? -1 : ftell(file);
    rewind(file);
    uint8_t* const bytes = size < 0 ? nullptr : (uint8_t*)on_line(size);
    const size_t prefix = error_size ? (size_t)snprintf(error, error_size, "%s: ", path) : 0;
    char* const reason = prefix < error_size ? error + prefix : nullptr;
    const size_t reason_size = prefix < error_size ? error_size - prefix : 0;
    if (bytes && fread(bytes, 1, size, file) == (size_t)size)
        policy = adopt(bytes, size, reason, reason_size);
    else {
        free(bytes);
        if (reason_size) snprintf(reason, reason_size, "expected a file that can be read");
    }
    fclose(file);
    return policy;
}

tsp_policy* tsp_load_memory(const void* bytes, size_t size, char* error, size_t error_size) {
    uint8_t* const copy = (uint8_t*)on_line(size);
    if (!copy) return nullptr;
    memcpy(copy, bytes, size);
    return adopt(copy, size, error, error_size);
}

tsp_info tsp_describe(const tsp_policy* policy) {
    const Header& h = policy->h;
    return {h.obs_steps, h.cond_dim, h.horizon - h.obs_steps + 1, h.action_dim, h.steps, policy->text};
}

int tsp_query(tsp_policy* policy, const float* history, uint64_t seed, float* chunk) {
    tsp_policy& p = *policy;
    const Header& h = p.h;
    if (!normalise(p.units, history, h.obs_steps, h.cond_dim, p.features)) return TSP_NOT_FINITE;
    philox::fill(seed, (size_t)h.steps * h.horizon * h.action_dim, p.noise);
    if (h.plan == PRUNER) decide(p);
    LEVELS[p.level].denoise(p.model, Member{}, p.mask, h.slots, p.noise, p.features, Guide{}, p.actions, p.scratch, p.scratch);
    const int32_t past = h.obs_steps - 1;
    unnormalise(p.units, p.actions + (size_t)past * h.action_dim, h.horizon - past, h.action_dim, chunk);
    return TSP_OK;
}

void tsp_free(tsp_policy* policy) {
    if (!policy) return;
    void* const owned[] = {policy->bytes, policy->layers, policy->folds, policy->mask, policy->scratch, policy->noise,
                           policy->features, policy->actions, policy->logits, policy->order, policy->text, policy};
    for (void* memory : owned) free(memory);
}
}
