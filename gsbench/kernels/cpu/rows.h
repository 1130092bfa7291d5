// Loads sixteen rows of a row-major array as columns of SIMD vectors, stores them, and copies or clears rows.
#pragma once

#include <cstddef>
#include <cstdint>

#include "simd.h"

namespace gsb {
inline namespace GSB_ISA {

alignas(64) constexpr float INDEX[LANES] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

// Returns how many of the items from i on, of `size`, a SIMD vector holds: zero or fewer if there are none.
GSB_HD inline int lanes_from(int64_t i, int64_t size) { return static_cast<int>(size - i < LANES ? size - i : LANES); }

// Returns the address of sixteen rows of `width` floats from row i on. If the array has only n of them, they are copied
// to `copy` and followed by zeros. The number is tested once per array and not for each lane of each column, which
// would take half a minute to compile, and with AVX2 up to half of a forward pass.
GSB_HD inline const float* sixteen_rows(const float* rows, int width, int64_t i, int n, float* copy) {
    const float* first = rows + i * width;
    if (n == LANES) return first;
    __builtin_memset(copy, 0, sizeof(float) * static_cast<size_t>(LANES * width));
    __builtin_memcpy(copy, first, sizeof(float) * static_cast<size_t>(n * width));
    return copy;
}

// Copies the first n of sixteen rows from `copy` to the array. If n is sixteen, they were written to the array
// directly.
GSB_HD inline void keep_rows(const float* copy, int width, float* rows, int64_t i, int n) {
    if (n < LANES) __builtin_memcpy(rows + i * width, copy, sizeof(float) * static_cast<size_t>(n * width));
}

template <int W>
GSB_HD inline void gather_row(const float* rows, int64_t i, int n, Vec (&out)[W]) {
    float copy[LANES * W];
    load_columns(sixteen_rows(rows, W, i, n, copy), out);
}

template <int W>
GSB_HD inline void scatter_row(const Vec (&x)[W], float* rows, int64_t i, int n) {
    float copy[LANES * W];
    store_columns(x, n == LANES ? rows + i * W : copy);
    keep_rows(copy, W, rows, i, n);
}

// Adds instead of storing. A Vec is rounded, unlike a Product, so the result does not depend on which views share a sum.
template <int W>
GSB_HD inline void add_row(const Vec (&x)[W], float* rows, int64_t i, int n) {
    Vec sum[W];
    gather_row(rows, i, n, sum);
    GSB_UNROLL for (int k = 0; k < W; ++k) sum[k] += x[k];
    scatter_row(sum, rows, i, n);
}
GSB_HD inline void add_first(Vec x, float* p, int n) { store_first(load_some(p, n) + x, p, n); }

template <int H, int W>
GSB_HD inline void gather_matrix(const float* rows, int64_t i, int n, Vec (&out)[H][W]) {
    Vec flat[H * W];
    gather_row(rows, i, n, flat);
    GSB_UNROLL for (int k = 0; k < H * W; ++k) out[k / W][k % W] = flat[k];
}

template <int H, int W>
GSB_HD inline void scatter_matrix(const Vec (&x)[H][W], float* rows, int64_t i, int n) {
    Vec flat[H * W];
    GSB_UNROLL for (int k = 0; k < H * W; ++k) flat[k] = x[k / W][k % W];
    scatter_row(flat, rows, i, n);
}

// Loads columns `first` to first + W - 1 of rows of any width.
template <int W>
GSB_HD inline void gather_columns(const float* rows, int width, int first, int64_t i, int n, Vec (&out)[W]) {
    GSB_UNROLL for (int k = 0; k < W; ++k) out[k] = gather(rows + i * width + first + k, width, n);
}

template <int W>
GSB_HD inline void add_columns(const Vec (&x)[W], float* rows, int width, int first, int64_t i, int n) {
    Vec sum[W];
    gather_columns(rows, width, first, i, n, sum);
    GSB_UNROLL for (int k = 0; k < W; ++k) scatter(sum[k] + x[k], rows + i * width + first + k, width, n);
}

// Loads rows i to i + n - 1 of an array, or some columns of it from `first` on, as `each` of raw parameters calls it.
struct LoadRows {
    int64_t i;
    int n;

    template <int W>
    GSB_HD void operator()(const float* rows, Vec (&x)[W]) const { gather_row(rows, i, n, x); }
    GSB_HD void operator()(const float* rows, Vec& x) const { x = load_first(rows + i, n); }
    template <int W>
    GSB_HD void operator()(const float* rows, int width, int first, Vec (&x)[W]) const {
        gather_columns(rows, width, first, i, n, x);
    }
    GSB_HD void operator()(const float* rows, int width, int first, Vec& x) const {
        x = gather(rows + i * width + first, width, n);
    }
};

// Adds to them.
struct AddRows {
    int64_t i;
    int n;

    template <int W>
    GSB_HD void operator()(float* rows, const Vec (&x)[W]) const { add_row(x, rows, i, n); }
    GSB_HD void operator()(float* rows, Vec x) const { add_first(x, rows + i, n); }
    template <int W>
    GSB_HD void operator()(float* rows, int width, int first, const Vec (&x)[W]) const {
        add_columns(x, rows, width, first, i, n);
    }
    GSB_HD void operator()(float* rows, int width, int first, Vec x) const {
        const Vec column[1] = {x};
        add_columns(column, rows, width, first, i, n);
    }
};

// Loads the raw parameters of Gaussians i to i + n - 1.
template <class Parameters, class Args>
GSB_HD inline Parameters load_raw(const Args& a, int64_t i, int n) {
    Parameters raw;
    raw.each(a, LoadRows{i, n});
    raw.opacity = load_first(a.opacities + i, n);
    return raw;
}

// Returns whether rows i to i + n - 1 of `width` floats are all zero; if a given gradient is zero, the result is zero
// too.
GSB_HD inline bool all_zero(const float* rows, int width, int64_t i, int n) {
    const float* p = rows + i * width;
    const int size = n * width;
    for (int k = 0; k < size; k += LANES) {
        const Vec x = load_some(p + k, size - k < LANES ? size - k : LANES);
        if (any(!(x == Vec(0.0f)))) return false;
    }
    return true;
}

constexpr int64_t FEW = 512;  // rows that are not worth a second thread

// Calls f(i, n) for each group of rows i to i + n - 1 of [first, end): sixteen, or what is left of them.
template <class F>
void each_sixteen(int64_t first, int64_t end, int threads, F f) {
#pragma omp parallel for num_threads(threads) schedule(static) if (end - first > FEW)
    for (int64_t i = first; i < end; i += LANES) f(i, lanes_from(i, end));
}

// Copies the rows [first, end). An array without rows has no address, which memcpy and memset do not accept.
GSB_HD inline void copy_rows(const float* from, float* to, int width, int64_t first, int64_t end) {
    if (first == end) return;
    __builtin_memcpy(to + first * width, from + first * width, sizeof(float) * static_cast<size_t>((end - first) * width));
}

GSB_HD inline void fill_zero(float* rows, int width, int64_t first, int64_t end) {
    if (first == end) return;
    __builtin_memset(rows + first * width, 0, sizeof(float) * static_cast<size_t>((end - first) * width));
}

// Sets rows of new arrays of `total` floats to zero. If these do not stay in cache, zeros are written past it: otherwise
// a processor reads all memory that it is about to overwrite. Call `finish_zeros` before other threads read them.
GSB_HD inline void zero_rows(float* rows, int width, int64_t first, int64_t end, int64_t total) {
#if defined(__SSE__)
    constexpr int64_t CACHED = 1 << 20;  // 4 MB: larger than the cache of a core
    if (total > CACHED) {
        float *p = rows + first * width, *const last = rows + end * width;
        for (; p < last && reinterpret_cast<uintptr_t>(p) % 16; ++p) *p = 0.0f;
        for (; p + 4 <= last; p += 4) _mm_stream_ps(p, _mm_setzero_ps());
        for (; p < last; ++p) *p = 0.0f;
        return;
    }
#endif
    fill_zero(rows, width, first, end);
}
GSB_HD inline void finish_zeros() {
#if defined(__SSE__)
    _mm_sfence();
#endif
}

}  // namespace GSB_ISA
}  // namespace gsb
