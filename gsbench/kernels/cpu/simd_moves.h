// Moves floats between memory and the lanes of a SIMD vector that is a pair of halves (simd_halves.h).
#pragma once

#include <cstdint>

#include "simd_halves.h"

#if defined(__AVX2__)
#include "simd_moves_avx2.h"
#else
#include "simd_moves_loops.h"
#endif

namespace gsb {
inline namespace GSB_ISA {

// Loads p[by] .. p[by + 15] with |by| < 16, from an aligned p.
template <int by>
GSB_HD inline Vec load_beside(const float* p) {
    return Vec::load(p + by);
}

// Sixteen offsets for reading and writing p[offset] in the lanes whose mask bit is set.
struct Places {
    const int32_t* offset;

    GSB_HD explicit Places(const int32_t* p) : offset(p) {}
};
GSB_HD inline Vec gather_at(const float* p, Places places, uint32_t bits) {
    if (bits == ALL_LANES) return gather_rows(p, places.offset, LANES);
    alignas(64) float lane[LANES];
    for (int i = 0; i < LANES; ++i) lane[i] = bits >> i & 1 ? p[places.offset[i]] : 0.0f;
    return Vec::load(lane);
}
GSB_HD inline void scatter_at(Vec x, float* p, Places places, uint32_t bits) {
    alignas(64) float lane[LANES];
    x.store(lane);
    if (bits == ALL_LANES) {
        GSB_UNROLL for (int i = 0; i < LANES; ++i) p[places.offset[i]] = lane[i];
    } else {
        for (; bits; bits &= bits - 1) p[places.offset[__builtin_ctz(bits)]] = lane[__builtin_ctz(bits)];
    }
}

// Stores four rows of four pixels with three channels; the rows are `stride` floats apart.
GSB_HD inline void store_rgb(Vec r, Vec g, Vec b, float* out, int64_t stride) {
    alignas(64) float lane[3][LANES];
    r.store(lane[0]);
    g.store(lane[1]);
    b.store(lane[2]);
    GSB_UNROLL for (int i = 0; i < LANES; ++i) {
        for (int k = 0; k < 3; ++k) out[i / 4 * stride + i % 4 * 3 + k] = lane[k][i];
    }
}
GSB_HD inline void load_rgb(const float* in, int64_t stride, Vec (&channels)[3]) {
    alignas(64) float lane[3][LANES];
    GSB_UNROLL for (int i = 0; i < LANES; ++i) {
        for (int k = 0; k < 3; ++k) lane[k][i] = in[i / 4 * stride + i % 4 * 3 + k];
    }
    for (int k = 0; k < 3; ++k) channels[k] = Vec::load(lane[k]);
}

// Returns the first n bytes as floats, and zero in the other lanes.
GSB_HD inline Vec load_bytes(const uint8_t* p, int n) {
    uint8_t bytes[LANES] = {};
    n == LANES ? __builtin_memcpy(bytes, p, LANES) : __builtin_memcpy(bytes, p, n);
    alignas(64) float lanes[LANES];
    for (int i = 0; i < LANES; ++i) lanes[i] = static_cast<float>(bytes[i]);
    return Vec::load(lanes);
}

// Writes base + k for each bit k that is set, in order, and returns their number.
GSB_HD inline int append_bits(uint32_t bits, uint32_t base, uint32_t* out) {
    int n = 0;
    for (; bits; bits &= bits - 1) out[n++] = base + static_cast<uint32_t>(__builtin_ctz(bits));
    return n;
}

}  // namespace GSB_ISA
}  // namespace gsb
