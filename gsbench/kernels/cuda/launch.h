// Launches a kernel. A build that runs the kernels on the CPU for tests (tests/kernels/cuda_shim.h) has its own
// `launch`.
#pragma once

#include <algorithm>

#include "../math/scalar.h"
#include "kernels.h"

#ifdef GSB_CUDA_SHIM
#include "cuda_shim.h"
#else
#include <cuda_runtime.h>

#include <new>
#include <stdexcept>
#include <string>

namespace gsb::cuda {

inline void check(cudaError_t status) {
    if (status == cudaErrorMemoryAllocation) throw std::bad_alloc();  // MemoryError in Python, as torch's own is
    if (status != cudaSuccess) throw std::runtime_error(std::string("CUDA: ") + cudaGetErrorString(status));
}

// Arguments are converted to the types of the kernel's parameters, as in a function call.
template <class... Parameters, class... Arguments>
void launch(void (*kernel)(Parameters...), dim3 grid, dim3 block, Stream stream, Arguments... arguments) {
    kernel<<<grid, block, 0, stream>>>(static_cast<Parameters>(arguments)...);
    check(cudaGetLastError());
}

inline void fill_bytes(void* at, unsigned char value, size_t bytes, Stream stream) {
    check(cudaMemsetAsync(at, value, bytes, stream));
}

}  // namespace gsb::cuda
#endif

namespace gsb::cuda {

GSB_HD constexpr int tiles_along(int pixels) { return (pixels + TILE - 1) / TILE; }

constexpr int THREADS = 256;  // of a block, where one thread does one thing
constexpr int WARP = 32;
constexpr unsigned ALL_LANES = 0xffffffffu;

inline unsigned blocks_for(int64_t threads) { return static_cast<unsigned>((threads + THREADS - 1) / THREADS); }

// Returns the number of rows of blocks of a kernel that has one for each camera; further cameras are taken in turns.
inline unsigned rows_for(int64_t cameras) {
    constexpr int64_t MOST_ROWS = 65535;
    return static_cast<unsigned>(cameras < MOST_ROWS ? cameras : MOST_ROWS);
}

// Returns the number of blocks of a kernel whose threads loop over `numbers` numbers: at least one, and at most as many
// as a large GPU runs at once.
inline unsigned looping_blocks(int64_t numbers) {
    constexpr unsigned MOST_BLOCKS = 1024;
    const unsigned blocks = blocks_for(numbers) + 1;
    return blocks < MOST_BLOCKS ? blocks : MOST_BLOCKS;
}

// Returns the size of the largest of several arrays; the sizes of those that are not there are 0.
inline int64_t largest(const int64_t (&numbers)[MAX_ADAM]) { return *std::max_element(numbers, numbers + MAX_ADAM); }

__device__ inline int64_t global_thread() { return static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; }

__device__ inline float warp_sum(float x) {
    for (int offset = WARP / 2; offset > 0; offset /= 2) x += __shfl_xor_sync(ALL_LANES, x, offset);
    return x;
}

}  // namespace gsb::cuda
