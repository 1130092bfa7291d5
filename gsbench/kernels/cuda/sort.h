// Sorting and cumulative sums on a GPU by CUB (sort.cu). A build that runs the kernels on the CPU for tests uses the
// standard library instead (tests/kernels/cuda_shim.cpp).
#pragma once

#include "kernels.h"

namespace gsb::cuda {

// Returns the bytes of scratch memory that each of these functions needs for n items.
size_t sort_scratch(int64_t n);

// Stable sort by the lowest `bits` bits of the keys, which have 16 or 32.
template <class Key>
void sort_pairs(void* scratch, size_t bytes, const Key* keys, Key* sorted_keys, const uint32_t* values,
                uint32_t* sorted_values, int64_t n, int bits, Stream);

// Replaces the values by their cumulative sums.
void running_sum(void* scratch, size_t bytes, int64_t* values, int64_t n, Stream);

}  // namespace gsb::cuda
