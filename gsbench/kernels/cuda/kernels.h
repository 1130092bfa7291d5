// The CUDA kernels: those of arguments.h, with device pointers, and what only a GPU has. A stream to run on comes last.
//
// Every function only enqueues work. Memory is the caller's, outputs and scratch alike, so that it comes from torch's
// caching allocator. N Gaussians before C cameras give C x N splats. The arguments' `threads` are the CPU's.
#pragma once

#include <cstddef>
#include <cstdint>

#include "../arguments.h"

struct CUstream_st;

namespace gsb {

// Splats to each tile's list.
struct BinArgs {
    int64_t N, C;
    const float *means2d, *roots, *depths, *half_sizes;
    int width, height;
};
GSB_FIELDS(BinArgs, INPUTS, N, C, means2d, roots, depths, half_sizes, width, height)

// All arrays are [C * N].
struct TileCounts {
    uint32_t *keys, *indices, *sorted_keys;
    uint32_t* order;  // splats by depth
    int64_t* ends;    // the running sum of the tiles that they touch, in this order
    void* scratch;
    size_t scratch_bytes;
};
GSB_FIELDS(TileCounts, OUTPUTS, keys, indices, sorted_keys, order, ends, scratch, scratch_bytes)

// Where `pairs` is not the last of `ends`, but the room there is, `tiles` are 0xffffffff on entry, and pairs beyond it
// are left out.
struct TileOrder {
    const uint32_t* order;
    const int64_t* ends;
    int64_t pairs;
};
GSB_FIELDS(TileOrder, INPUTS, order, ends, pairs)

// The arrays are [pairs], but for `offsets`.
struct TileLists {
    uint32_t *tiles, *splats, *sorted_tiles;
    uint32_t* ids;     // splats of all cameras, each tile's front to back
    int32_t* offsets;  // [C * tiles + 1] where each tile's list begins
    void* scratch;
    size_t scratch_bytes;
};
GSB_FIELDS(TileLists, OUTPUTS, tiles, splats, sorted_tiles, ids, offsets, scratch, scratch_bytes)

}  // namespace gsb

// `blend_backward` has a pixel a lane, and `blend_backward_by_splat` a splat: the same gradients.
#define GSB_CUDA_KERNELS(kernel)                                                                   \
    GSB_KERNELS(kernel)                                                                            \
    kernel(count_tiles, BinArgs, TileCounts)                                                       \
    kernel(fill_tiles, BinArgs, TileOrder, TileLists)                                              \
    kernel(blend_backward_by_splat, BlendArgs, BlendState, PictureGrads, BlendGrads)

namespace gsb::cuda {

using Stream = CUstream_st*;

#define GSB_DECLARATION(name, ...) void name(GSB_PARAMETERS(__VA_ARGS__), Stream);
GSB_CUDA_KERNELS(GSB_DECLARATION)
#undef GSB_DECLARATION

// What `refine` has room for: numbers that the networks read, and numbers that one of them moves.
constexpr int MAX_FEATURES = 7, MAX_WIDTH = 28;

// Parts that `l1_ssim` leaves of its loss.
int similarity_parts(int height, int width);

}  // namespace gsb::cuda
