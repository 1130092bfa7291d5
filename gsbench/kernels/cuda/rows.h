// Loads rows of arrays to registers and stores them, for kernels in which one thread slices one Gaussian.
#pragma once

#include "../math/beta_slice.h"

#include "launch.h"

namespace gsb::cuda {

template <int COUNT>
__device__ inline void load_row(const float* rows, int64_t i, float (&out)[COUNT]) {
    GSB_UNROLL for (int k = 0; k < COUNT; ++k) out[k] = rows[i * COUNT + k];
}

template <int COUNT>
__device__ inline void store_row(const float (&row)[COUNT], float* rows, int64_t i) {
    GSB_UNROLL for (int k = 0; k < COUNT; ++k) rows[i * COUNT + k] = row[k];
}

template <int COUNT>
__device__ inline void add_row(const float (&row)[COUNT], float* rows, int64_t i) {
    GSB_UNROLL for (int k = 0; k < COUNT; ++k) rows[i * COUNT + k] += row[k];
}

// Loads a row of an array, or some columns of it from `first` on, as `each` of raw parameters calls it.
struct LoadRow {
    int64_t row;

    template <int COUNT>
    __device__ void operator()(const float* rows, float (&x)[COUNT]) const { load_row(rows, row, x); }
    __device__ void operator()(const float* rows, float& x) const { x = rows[row]; }
    template <int COUNT>
    __device__ void operator()(const float* rows, int width, int first, float (&x)[COUNT]) const {
        GSB_UNROLL for (int k = 0; k < COUNT; ++k) x[k] = rows[row * width + first + k];
    }
    __device__ void operator()(const float* rows, int width, int first, float& x) const { x = rows[row * width + first]; }
};

// Adds to it.
struct AddRow {
    int64_t row;

    template <int COUNT>
    __device__ void operator()(float* rows, const float (&x)[COUNT]) const { add_row(x, rows, row); }
    __device__ void operator()(float* rows, float x) const { rows[row] += x; }
    template <int COUNT>
    __device__ void operator()(float* rows, int width, int first, const float (&x)[COUNT]) const {
        GSB_UNROLL for (int k = 0; k < COUNT; ++k) rows[row * width + first + k] += x[k];
    }
    __device__ void operator()(float* rows, int width, int first, float x) const { rows[row * width + first] += x; }
};

// Returns the row of the raw parameters of Gaussian i that a view sees.
template <class Args>
__device__ int64_t raw_row(const Args& a, int64_t view, int64_t i) {
    return a.raw_per_view ? view * a.N + i : i;
}

// Loads the raw parameters of Gaussian i from row `row` of all arrays but that of the opacities, which views share.
template <class Parameters, class Args>
__device__ Parameters load_raw(const Args& a, int64_t row, int64_t i) {
    Parameters raw{};
    raw.each(a, LoadRow{row});
    raw.opacity = a.opacities[i];
    return raw;
}

// Adds the numbers of a structure that consists of floats.
template <class Parameters>
__device__ void accumulate(Parameters& sum, const Parameters& x) {
    constexpr int COUNT = sizeof(Parameters) / sizeof(float);
    add_row(reinterpret_cast<const float(&)[COUNT]>(x), reinterpret_cast<float*>(&sum), 0);
}

template <int ROWS, int COUNT>
__device__ inline void load_matrix(const float* rows, int64_t i, float (&out)[ROWS][COUNT]) {
    GSB_UNROLL for (int row = 0; row < ROWS; ++row) load_row(rows, i * ROWS + row, out[row]);
}

template <int ROWS, int COUNT>
__device__ inline void store_matrix(const float (&matrix)[ROWS][COUNT], float* rows, int64_t i) {
    GSB_UNROLL for (int row = 0; row < ROWS; ++row) store_row(matrix[row], rows, i * ROWS + row);
}

__device__ inline void store_observed(const Observed<float>& seen, const Observation& out, int64_t i) {
    store_row(seen.mean, out.means, i);
    store_matrix(seen.factor, out.factors, i);
    out.opacities[i] = seen.opacity;
}

// Stores a static Gaussian, whose mean is copied from row `row` of `means`.
template <class Gaussian>
__device__ void store_static(const Gaussian& gaussian, const float* means, int64_t row, const Observation& out,
                             int64_t i) {
    float mean[3];
    load_row(means, row, mean);
    store_row(mean, out.means, i);
    store_matrix(gaussian.factor, out.factors, i);
    out.opacities[i] = gaussian.opacity;
}

template <class Gaussian>
__device__ void store_static(const Gaussian& gaussian, const float* means, int64_t row, const BetaSlice& out, int64_t i) {
    store_static(gaussian, means, row, Observation{out.means, out.factors, out.opacities}, i);
    out.shapes[i] = gaussian.shape;
}

__device__ inline Observed<float> load_observed(const ObservationGrads& o, int64_t i) {
    Observed<float> out;
    load_row(o.means, i, out.mean);
    load_matrix(o.factors, i, out.factor);
    out.opacity = o.opacities[i];
    return out;
}

__device__ inline void store_observed(const ObservedBeta<float>& seen, const BetaSlice& out, int64_t i) {
    store_observed(seen, Observation{out.means, out.factors, out.opacities}, i);
    out.shapes[i] = seen.shape;
}

__device__ inline ObservedBeta<float> load_observed(const BetaSliceGrads& o, int64_t i) {
    return {load_observed(ObservationGrads{o.means, o.factors, o.opacities}, i), o.shapes[i]};
}

constexpr int SMALL_BLOCK = 128;  // a thread needs many registers

inline unsigned small_blocks(int64_t N) { return static_cast<unsigned>((N + SMALL_BLOCK - 1) / SMALL_BLOCK); }

}  // namespace gsb::cuda
