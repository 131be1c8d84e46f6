// What layout.h describes, declared; and its hash, which layout.py computes likewise.

#pragma once

#include <stddef.h>
#include <stdint.h>

namespace {
#define CONSTANT(name, value) constexpr auto name = value;
#define STRUCT(name)
#define FIELD(type, name)
#define END
#include "layout.h"
}  // namespace

extern "C" {
typedef char Magic[8];

#define CONSTANT(name, value)
#define STRUCT(name) struct name {
#define FIELD(type, name) type name;
#define END };
#include "layout.h"
}

static_assert(sizeof(Header) == 104, "a padding, or another TSP_VERSION");

namespace {

// FNV-1a.
constexpr uint64_t mix(uint64_t hash, const char* text) {
    while (*text) hash = (hash ^ (uint8_t)*text++) * 0x100000001b3u;
    return hash;
}

constexpr uint64_t mix(uint64_t hash, size_t number) {
    for (int i = 0; i < 8; i++) hash = (hash ^ (number >> 8 * i & 255)) * 0x100000001b3u;
    return hash;
}

constexpr uint64_t mix(uint64_t hash, int number) { return mix(hash, (size_t)number); }

// Of every name, type and value, and of where the compiler has put each field.
constexpr uint64_t layout_hash() {
    uint64_t hash = 0xcbf29ce484222325u;
#define CONSTANT(name, value) hash = mix(mix(hash, #name), name);
#define STRUCT(name)
#define FIELD(type, name)
#define END
#include "layout.h"
#define CONSTANT(name, value)
#define STRUCT(name) { typedef name Struct; hash = mix(mix(hash, #name), sizeof(Struct));
#define FIELD(type, name) hash = mix(mix(mix(mix(hash, #type), #name), offsetof(Struct, name)), sizeof(Struct::name));
#define END }
#include "layout.h"
    return hash;
}

}  // namespace
