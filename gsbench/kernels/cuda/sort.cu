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

template <class Key>
size_t scratch_of_sort(int64_t n) {
    const Key* keys = nullptr;
    Key* sorted_keys = nullptr;
    const uint32_t* values = nullptr;
    uint32_t* sorted_values = nullptr;
    size_t bytes = 0;
    check(cub::DeviceRadixSort::SortPairs(nullptr, bytes, keys, sorted_keys, values, sorted_values, count(n)));
    return bytes;
}

}  // namespace

size_t sort_scratch(int64_t n) {
    int64_t* values = nullptr;
    size_t sum = 0;
    check(cub::DeviceScan::InclusiveSum(nullptr, sum, values, values, count(n)));
    return std::max({scratch_of_sort<uint16_t>(n), scratch_of_sort<uint32_t>(n), sum});
}

template <class Key>
void sort_pairs(void* scratch, size_t bytes, const Key* keys, Key* sorted_keys, const uint32_t* values,
                uint32_t* sorted_values, int64_t n, int bits, Stream stream) {
    check(cub::DeviceRadixSort::SortPairs(scratch, bytes, keys, sorted_keys, values, sorted_values, count(n), 0, bits,
                                          stream));
}

template void sort_pairs(void*, size_t, const uint16_t*, uint16_t*, const uint32_t*, uint32_t*, int64_t, int, Stream);
template void sort_pairs(void*, size_t, const uint32_t*, uint32_t*, const uint32_t*, uint32_t*, int64_t, int, Stream);

void running_sum(void* scratch, size_t bytes, int64_t* values, int64_t n, Stream stream) {
    check(cub::DeviceScan::InclusiveSum(scratch, bytes, values, values, count(n), stream));
}

}  // namespace gsb::cuda
