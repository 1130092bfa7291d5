// Sixteen rows of a row-major array as columns of vectors, and back.
#pragma once

#include <cstdint>

#include "simd.h"

namespace gsb {
inline namespace GSB_ISA {

alignas(64) constexpr float INDEX[LANES] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

// How many of the rows i, i + 1, .. of `size` a vector holds.
GSB_HD inline int lanes_from(int64_t i, int64_t size) { return static_cast<int>(size - i < LANES ? size - i : LANES); }

template <int W>
GSB_HD inline void gather_row(const float* rows, int64_t i, int n, Vec (&out)[W]) {
    GSB_UNROLL for (int k = 0; k < W; ++k) out[k] = gather(rows + i * W + k, W, n);
}

template <int W>
GSB_HD inline void scatter_row(const Vec (&x)[W], float* rows, int64_t i, int n) {
    GSB_UNROLL for (int k = 0; k < W; ++k) scatter(x[k], rows + i * W + k, W, n);
}

template <int H, int W>
GSB_HD inline void gather_matrix(const float* rows, int64_t i, int n, Vec (&out)[H][W]) {
    GSB_UNROLL for (int k = 0; k < H * W; ++k) out[k / W][k % W] = gather(rows + i * (H * W) + k, H * W, n);
}

template <int H, int W>
GSB_HD inline void scatter_matrix(const Vec (&x)[H][W], float* rows, int64_t i, int n) {
    GSB_UNROLL for (int k = 0; k < H * W; ++k) scatter(x[k / W][k % W], rows + i * (H * W) + k, H * W, n);
}

}  // namespace GSB_ISA
}  // namespace gsb
