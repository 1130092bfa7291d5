// Moves floats between memory and the lanes of a SIMD vector, one by one, where the CPU has neither AVX2 nor AVX-512.
#pragma once

#include <cstdint>

namespace gsb {
inline namespace GSB_ISA {

// Loads p[lane * stride] to the first n lanes, and zero to the others; `scatter` stores them.
GSB_HD inline Vec gather(const float* p, int stride, int n = LANES) {
    if (n == LANES) return Vec::gather(p, stride);
    alignas(64) float lane[LANES] = {};
    for (int i = 0; i < n; ++i) lane[i] = p[i * stride];
    return Vec::load(lane);
}
GSB_HD inline void scatter(Vec x, float* p, int stride, int n = LANES) {
    if (n == LANES) return x.scatter(p, stride);
    alignas(64) float lane[LANES];
    x.store(lane);
    for (int i = 0; i < n; ++i) p[i * stride] = lane[i];
}

// Loads sixteen adjacent rows of W floats as W columns; `store_columns` stores them.
template <int W>
GSB_HD inline void load_columns(const float* p, Vec (&out)[W]) {
    GSB_UNROLL for (int k = 0; k < W; ++k) out[k] = gather(p + k, W);
}
template <int W>
GSB_HD inline void store_columns(const Vec (&x)[W], float* p) {
    GSB_UNROLL for (int k = 0; k < W; ++k) scatter(x[k], p + k, W);
}

// Loads p[offsets[lane]] to the first n lanes, and zero to the others; `scatter_rows` stores them.
GSB_HD inline Vec gather_rows(const float* p, const int32_t* offsets, int n) {
    alignas(64) float lane[LANES];
    if (n == LANES) {
        GSB_UNROLL for (int i = 0; i < LANES; ++i) lane[i] = p[offsets[i]];
    } else {
        for (int i = 0; i < LANES; ++i) lane[i] = i < n ? p[offsets[i]] : 0.0f;
    }
    return Vec::load(lane);
}

// Loads the first n floats of p, and zero to the other lanes; `store_first` stores them.
GSB_HD inline Vec load_some(const float* p, int n) { return n == LANES ? Vec::load(p) : gather(p, 1, n); }
GSB_HD inline void store_first(Vec x, float* p, int n) { n == LANES ? x.store(p) : scatter(x, p, 1, n); }

// Transposes sixteen rows of sixteen floats.
GSB_HD inline void transpose(Vec (&x)[LANES]) {
    alignas(64) float rows[LANES][LANES];
    for (int i = 0; i < LANES; ++i) x[i].store(rows[i]);
    for (int k = 0; k < LANES; ++k) x[k] = Vec::gather(rows[0] + k, LANES);
}

// Returns the vector whose lane i is lane from[i] of x.
GSB_HD inline Vec permute(Vec x, const int32_t* from) {
    alignas(64) float in[LANES], out[LANES];
    x.store(in);
    for (int i = 0; i < LANES; ++i) out[i] = in[from[i]];
    return Vec::load(out);
}

}  // namespace GSB_ISA
}  // namespace gsb
