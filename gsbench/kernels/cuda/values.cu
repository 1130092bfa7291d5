// Checks in one pass whether the rasterizer's inputs are finite and in range; math/values.h has the ranges.
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

}  // namespace

void flag_values(const ValueArgs& a, const ValueFlags& out, Stream stream) {
    constexpr unsigned MOST_BLOCKS = 512;
    const unsigned blocks = blocks_for(a.N * 9) + 1;
    launch(flag_kernel, blocks < MOST_BLOCKS ? blocks : MOST_BLOCKS, THREADS, stream, ranges_of(a), out.flags);
}

}  // namespace gsb::cuda
