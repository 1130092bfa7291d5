// The CUDA kernels: those of arguments.h with device pointers, and kernels that exist only on a GPU. The last argument
// of each function is a stream.
//
// Every function only enqueues work. The caller provides the memory of outputs and scratch, so that it comes from
// torch's caching allocator. N Gaussians and C cameras give C x N projected Gaussians (splats). `threads` is used only
// on the CPU.
#pragma once

#include <cstddef>
#include <cstdint>

#include "../arguments.h"

struct CUstream_st;

namespace gsb {

// The inputs of the kernels that list the splats of each tile.
struct BinArgs {
    int64_t N, C;
    const float *means2d, *roots, *depths, *half_sizes;
    const float* shapes;  // null: Gaussians
    int width, height;
};
GSB_FIELDS(BinArgs, INPUTS, N, C, means2d, roots, depths, half_sizes, shapes, width, height)

// The arrays are [C * N].
struct TileCounts {
    uint32_t *keys, *indices, *sorted_keys;
    uint32_t* order;  // splats by depth
    int64_t* ends;    // the running sum of the tiles that they touch, in this order
    void* scratch;
    size_t scratch_bytes;
};
GSB_FIELDS(TileCounts, OUTPUTS, keys, indices, sorted_keys, order, ends, scratch, scratch_bytes)

// `pairs` is the number of tile intersections for which there is memory. If it is not the last entry of `ends`, `tiles`
// must be 0xffffffff on entry, and further intersections are left out.
struct TileOrder {
    const uint32_t* order;
    const int64_t* ends;
    int64_t pairs;
};
GSB_FIELDS(TileOrder, INPUTS, order, ends, pairs)

// The arrays are [pairs], except `offsets`.
struct TileLists {
    uint32_t *tiles, *splats, *sorted_tiles;
    uint32_t* ids;     // splats of all cameras, each tile's front to back
    int32_t* offsets;  // [C * tiles + 1] where each tile's list begins
    void* scratch;
    size_t scratch_bytes;
};
GSB_FIELDS(TileLists, OUTPUTS, tiles, splats, sorted_tiles, ids, offsets, scratch, scratch_bytes)

// What density control adds up of C cameras.
struct DensityArgs {
    int64_t N, C;
    const bool* drawn;       // [C, N]: which Gaussians are not culled
    const float* g_means2d;  // [C, N, 2], per pixel
    float scale_x, scale_y;  // from one over pixels to units of half the image
};
GSB_FIELDS(DensityArgs, INPUTS, N, C, drawn, g_means2d, scale_x, scale_y)

// The arrays are [N] and changed.
struct DensityState {
    float *gradient, *times_visible;  // sums over cameras: norms of gradients, cameras in which it was drawn
    int32_t* unseen;                  // cameras since it was last drawn; may be null
};
GSB_FIELDS(DensityState, OUTPUTS, gradient, times_visible, unseen)

}  // namespace gsb

// `blend_backward` has one lane per pixel, and `blend_backward_by_splat` one lane per splat; the gradients are the
// same.
#define GSB_CUDA_KERNELS(kernel)                                                                   \
    GSB_KERNELS(kernel)                                                                            \
    kernel(count_tiles, BinArgs, TileCounts)                                                       \
    kernel(fill_tiles, BinArgs, TileOrder, TileLists)                                              \
    kernel(add_density, DensityArgs, DensityState)                                                 \
    kernel(blend_backward_by_splat, BlendArgs, BlendState, PictureGrads, BlendGrads)

namespace gsb::cuda {

using Stream = CUstream_st*;

#define GSB_DECLARATION(name, ...) void name(GSB_PARAMETERS(__VA_ARGS__), Stream);
GSB_CUDA_KERNELS(GSB_DECLARATION)
#undef GSB_DECLARATION

// The limits of `refine` (AGR): how many numbers the MLPs read, and how many one MLP changes.
constexpr int MAX_FEATURES = 7, MAX_WIDTH = 28;

// Returns the number of partial sums of the loss that `l1_ssim` writes.
int similarity_parts(int height, int width);

}  // namespace gsb::cuda
