// Sorting and summing on the device, behind functions: CUB's (sort.cu), or the standard library's where the kernels run
// on the CPU (tests/kernels/cuda_shim.cpp).
#pragma once

#include "kernels.h"

namespace gsb::cuda {

// Bytes of scratch that either function needs for n items.
size_t scratch_bytes(int64_t n);

// Stable, by the lowest `bits` of the keys.
void sort_pairs(void* scratch, size_t bytes, const uint32_t* keys, uint32_t* sorted_keys, const uint32_t* values,
                uint32_t* sorted_values, int64_t n, int bits, Stream);

// In place.
void running_sum(void* scratch, size_t bytes, int64_t* values, int64_t n, Stream);

}  // namespace gsb::cuda
