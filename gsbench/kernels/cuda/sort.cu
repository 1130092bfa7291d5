// Sorting and cumulative sums by CUB. The number of items is an int, for which CUB has kernels with 32-bit offsets; the
// caller checks that there are not more (raster.py).
#include "sort.h"

#include <algorithm>
#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>
#include <limits>
#include <stdexcept>

#include "launch.h"

namespace gsb::cuda {

namespace {

int count(int64_t n) {
    if (n < 0 || n > std::numeric_limits<int>::max()) throw std::length_error("CUDA: too many items to sort");
    return static_cast<int>(n);
}

}  // namespace

size_t scratch_bytes(int64_t n) {
    const uint32_t* keys = nullptr;
    uint32_t* sorted = nullptr;
    int64_t* values = nullptr;
    size_t sort = 0, sum = 0;
    check(cub::DeviceRadixSort::SortPairs(nullptr, sort, keys, sorted, keys, sorted, count(n)));
    check(cub::DeviceScan::InclusiveSum(nullptr, sum, values, values, count(n)));
    return std::max(sort, sum);
}

void sort_pairs(void* scratch, size_t bytes, const uint32_t* keys, uint32_t* sorted_keys, const uint32_t* values,
                uint32_t* sorted_values, int64_t n, int bits, Stream stream) {
    check(cub::DeviceRadixSort::SortPairs(scratch, bytes, keys, sorted_keys, values, sorted_values, count(n), 0, bits,
                                          stream));
}

void running_sum(void* scratch, size_t bytes, int64_t* values, int64_t n, Stream stream) {
    check(cub::DeviceScan::InclusiveSum(scratch, bytes, values, values, count(n), stream));
}

}  // namespace gsb::cuda
