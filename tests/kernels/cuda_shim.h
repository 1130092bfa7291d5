// CUDA on the CPU, as far as gsbench/kernels/cuda uses it: the threads of a block are fibers that take turns.
//
// A fiber runs until it needs the others: at a barrier, or where its warp exchanges values. Blocks run one after the
// other. This proves what a kernel computes, not how fast it is. Of races within a block it finds such as show when fibers
// take turns in one order and then in the other (GSBENCH_SHIM_REVERSED); built with ThreadSanitizer (GSBENCH_SANITIZE=
// thread) all that happen: there __syncthreads and __syncwarp order memory, and shuffles and votes do not, as CUDA has it.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <functional>
#include <stdexcept>

#include "../../gsbench/kernels/cuda/kernels.h"

#define __global__
#define __device__
#define __host__
#define __shared__ static  // blocks run one at a time, and a block's fibers share it
#define __launch_bounds__(...)
#define __grid_constant__

struct dim3 {
    unsigned x, y, z;
    dim3(unsigned x = 1, unsigned y = 1, unsigned z = 1) : x(x), y(y), z(z) {}
};
struct float2 { float x, y; };
struct float4 { float x, y, z, w; };

namespace gsb::cuda::shim {

struct Thread {
    dim3 index;
    unsigned number;  // in its block
};

extern const Thread* thread;  // that runs
extern dim3 block_index, block_size, grid_size;

void run(dim3 grid, dim3 block, const std::function<void()>& body);
void barrier();                           // of the block
void sync_warp();
const uint32_t* exchange(uint32_t mine);  // what the lanes of the warp gave, once all that live have; 0 of others

template <class T>
uint32_t bits(T x) {
    static_assert(sizeof(T) == 4);
    uint32_t out;
    std::memcpy(&out, &x, 4);
    return out;
}

template <class T>
T value(uint32_t bits) {
    T out;
    std::memcpy(&out, &bits, 4);
    return out;
}

}  // namespace gsb::cuda::shim

#define threadIdx (gsb::cuda::shim::thread->index)
#define blockIdx (gsb::cuda::shim::block_index)
#define blockDim (gsb::cuda::shim::block_size)
#define gridDim (gsb::cuda::shim::grid_size)

inline void __syncthreads() { gsb::cuda::shim::barrier(); }
inline void __syncwarp() { gsb::cuda::shim::sync_warp(); }

template <class T>
T __shfl_xor_sync(unsigned, T x, int offset) {
    using namespace gsb::cuda::shim;
    return value<T>(exchange(bits(x))[static_cast<int>(thread->number % 32) ^ offset]);
}

template <class T>
T __shfl_sync(unsigned, T x, int lane) {
    using namespace gsb::cuda::shim;
    return value<T>(exchange(bits(x))[lane % 32]);
}

inline unsigned __ballot_sync(unsigned, bool predicate) {
    const uint32_t* lanes = gsb::cuda::shim::exchange(predicate);
    unsigned all = 0;
    for (int lane = 0; lane < 32; ++lane) all |= lanes[lane] << lane;
    return all;
}
inline bool __any_sync(unsigned mask, bool predicate) { return __ballot_sync(mask, predicate) != 0; }

inline float __fdividef(float x, float y) { return x / y; }
inline float __log2f(float x) { return std::log2(x); }
inline int __popc(unsigned x) { return __builtin_popcount(x); }
inline uint32_t __float_as_uint(float x) { return gsb::cuda::shim::bits(x); }

#define GSB_ATOMIC __attribute__((no_sanitize("thread")))

template <class T>
GSB_ATOMIC T atomicAdd(T* at, T x) {
    const T old = *at;
    *at += x;
    return old;
}
template <class T>
GSB_ATOMIC T atomicOr(T* at, T x) {
    const T old = *at;
    *at |= x;
    return old;
}

namespace gsb::cuda {

template <class... Parameters, class... Arguments>
void launch(void (*kernel)(Parameters...), dim3 grid, dim3 block, Stream, Arguments... arguments) {
    if (grid.x * grid.y * grid.z == 0) throw std::runtime_error("CUDA: invalid argument");  // as a GPU says
    shim::run(grid, block, [&] { kernel(static_cast<Parameters>(arguments)...); });
}

inline void fill_bytes(void* at, unsigned char value, size_t bytes, Stream) { std::memset(at, value, bytes); }

}  // namespace gsb::cuda
