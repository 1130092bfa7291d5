// Checks in one pass whether the rasterizer's inputs are finite and in range, or whether gradients are finite;
// math/values.h has the ranges.
#include "../math/values.h"

#include "launch.h"

namespace gsb::cuda {
namespace {

__global__ void flag_kernel(const __grid_constant__ Ranges ranges, int64_t* flags) {
    const int64_t step = static_cast<int64_t>(gridDim.x) * blockDim.x;
    for (const Range& r : ranges.range) {
        bool good = true;
        for (int64_t i = global_thread(); i < r.count; i += step) {
            const float x = r.values[i * r.stride];
            good &= x >= r.low && x <= r.high;  // false for NaN
        }
        if (!good) atomicOr(reinterpret_cast<unsigned long long*>(flags), 1ull << r.bit);
    }
}

__global__ void flag_arrays_kernel(const __grid_constant__ FiniteArgs a, ArrayFlags out) {
    const int64_t step = static_cast<int64_t>(gridDim.x) * blockDim.x;
    for (int i = 0; i < a.count; ++i) {
        bool good = true;
        for (int64_t k = global_thread(); k < a.numbers[i]; k += step) {
            const float x = a.arrays[i][k];
            good &= x >= -FLT_MAX && x <= FLT_MAX;  // false for NaN
        }
        if (!good) out.flags[i] = *out.skip = 1.0f;  // all threads write the same
    }
}

}  // namespace

void flag_values(const ValueArgs& a, const ValueFlags& out, Stream stream) {
    launch(flag_kernel, looping_blocks(a.N * 9), THREADS, stream, ranges_of(a), out.flags);
}

void flag_arrays(const FiniteArgs& a, const ArrayFlags& out, Stream stream) {
    launch(flag_arrays_kernel, looping_blocks(largest(a.numbers)), THREADS, stream, a, out);
}

}  // namespace gsb::cuda
