// NumPy's default_rng(seed).permutation(n), bit by bit, and zlib's CRC-32: which points a full pillar keeps.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <numeric>
#include <utility>
#include <vector>

inline uint32_t crc32(const void* data, size_t size) {
    uint32_t crc = 0xffffffff;
    for (auto* byte = static_cast<const uint8_t*>(data); size > 0; --size, ++byte) {
        crc ^= *byte;
        for (int bit = 0; bit < 8; ++bit) crc = crc & 1 ? 0xedb88320 ^ (crc >> 1) : crc >> 1;
    }
    return ~crc;
}

// SeedSequence of one word, PCG64 (XSL-RR 128/64), masked rejection.
class Generator {
public:
    explicit Generator(uint32_t seed) {
        const auto words = seed_words(seed);
        const auto wide = [&](int i) { return Wide{words[i]} | Wide{words[i + 1]} << 32; };
        increment_ = (wide(4) << 64 | wide(6)) << 1 | 1;
        state_ = increment_ + (wide(0) << 64 | wide(2));
        step();
    }

    std::vector<int64_t> permutation(int64_t n) {
        std::vector<int64_t> order(n);
        std::iota(order.begin(), order.end(), 0);
        for (int64_t i = n - 1; i > 0; --i) std::swap(order[i], order[up_to(static_cast<uint32_t>(i))]);
        return order;
    }

private:
    using Wide = unsigned __int128;

    void step() { state_ = state_ * (Wide{0x2360ed051fc65da4} << 64 | 0x4385df649fccf645) + increment_; }

    uint32_t next() {
        if (has_spare_) {
            has_spare_ = false;
            return spare_;
        }
        step();
        const auto high = static_cast<uint64_t>(state_ >> 64);
        const uint64_t mixed = high ^ static_cast<uint64_t>(state_);
        const int turn = static_cast<int>(high >> 58);
        const uint64_t value = turn ? mixed >> turn | mixed << (64 - turn) : mixed;
        spare_ = static_cast<uint32_t>(value >> 32);
        has_spare_ = true;
        return static_cast<uint32_t>(value);
    }

    uint32_t up_to(uint32_t highest) {
        const uint32_t mask = 0xffffffffu >> __builtin_clz(highest);
        uint32_t value;
        do value = next() & mask;
        while (value > highest);
        return value;
    }

    static std::array<uint32_t, 8> seed_words(uint32_t seed) {
        uint32_t constant = 0x43b0d7e5;
        const auto hash = [&](uint32_t value, uint32_t factor) {
            value ^= constant;
            constant *= factor;
            value *= constant;
            return value ^ value >> 16;
        };
        const auto mix = [](uint32_t a, uint32_t b) {
            const uint32_t value = 0xca01f9dd * a - 0x4973f715 * b;
            return value ^ value >> 16;
        };
        std::array<uint32_t, 4> pool{seed, 0, 0, 0};
        for (auto& word : pool) word = hash(word, 0x931e8875);
        for (int from = 0; from < 4; ++from)
            for (int to = 0; to < 4; ++to)
                if (from != to) pool[to] = mix(pool[to], hash(pool[from], 0x931e8875));
        constant = 0x8b51f9dd;
        std::array<uint32_t, 8> words;
        for (int i = 0; i < 8; ++i) words[i] = hash(pool[i % 4], 0x58f38ded);
        return words;
    }

    Wide state_ = 0, increment_ = 0;
    uint32_t spare_ = 0;
    bool has_spare_ = false;
};
