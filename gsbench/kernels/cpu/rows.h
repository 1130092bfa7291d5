// Sixteen rows of a row-major array as columns of vectors, and back; rows that are copied, or zero.
#pragma once

#include <cstddef>
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

// Columns `first` to first + W of rows of any width.
template <int W>
GSB_HD inline void gather_columns(const float* rows, int width, int first, int64_t i, int n, Vec (&out)[W]) {
    GSB_UNROLL for (int k = 0; k < W; ++k) out[k] = gather(rows + i * width + first + k, width, n);
}

template <int W>
GSB_HD inline void scatter_columns(const Vec (&x)[W], float* rows, int width, int first, int64_t i, int n) {
    GSB_UNROLL for (int k = 0; k < W; ++k) scatter(x[k], rows + i * width + first + k, width, n);
}

// Rows [first, end). Arrays of no rows have no address, which memcpy and memset do not take.
GSB_HD inline void copy_rows(const float* from, float* to, int width, int64_t first, int64_t end) {
    if (first == end) return;
    __builtin_memcpy(to + first * width, from + first * width, sizeof(float) * static_cast<size_t>((end - first) * width));
}

GSB_HD inline void fill_zero(float* rows, int width, int64_t first, int64_t end) {
    if (first == end) return;
    __builtin_memset(rows + first * width, 0, sizeof(float) * static_cast<size_t>((end - first) * width));
}

}  // namespace GSB_ISA
}  // namespace gsb
