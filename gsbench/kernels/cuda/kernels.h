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

// What `draw` computes between projecting and blending: each tile's list of splats.
struct TileLists {
    int64_t room;      // the number of tile intersections for which there is memory; further ones are left out
    int32_t* offsets;  // [C * tiles + 1]: tile t's list is [offsets[t], offsets[t + 1]) of `ids`
    int32_t* ids;      // [room] splats of all cameras, each tile's front to back
    int64_t* needed;   // [2]: the number of tile intersections that there are; the flags of ValueFlags
    void* scratch;
    size_t scratch_bytes;  // as many as `draw_scratch` returns
};
GSB_FIELDS(TileLists, OUTPUTS, room, offsets, ids, needed, scratch, scratch_bytes)

// What density control adds up of C cameras.
struct DensityArgs {
    int64_t N, C;
    const bool* drawn;       // [C, N]: which Gaussians are not culled
    const float* g_means2d;  // [C, N, 2], per pixel
    float scale_x, scale_y;  // from one over pixels to units of half the image
    const float* skip;       // [1]: nothing is added unless it is 0
};
GSB_FIELDS(DensityArgs, INPUTS, N, C, drawn, g_means2d, scale_x, scale_y, skip)

// The arrays are [N] and changed.
struct DensityState {
    float *gradient, *times_visible;  // sums over cameras: norms of gradients, cameras in which it was drawn
    int32_t* unseen;                  // cameras since it was last drawn; may be null
};
GSB_FIELDS(DensityState, OUTPUTS, gradient, times_visible, unseen)

}  // namespace gsb

// `draw` checks values, projects, lists the splats of each tile and blends; the inputs of blending are outputs of the
// earlier kernels. If a value is bad, or `room` too small, each image gets a NaN, so that its loss is NaN.
#define GSB_CUDA_KERNELS(kernel)                                                                   \
    GSB_KERNELS(kernel)                                                                            \
    kernel(draw, ProjectArgs, Splats, BlendArgs, Picture, TileLists)                               \
    kernel(add_density, DensityArgs, DensityState)

namespace gsb::cuda {

using Stream = CUstream_st*;

#define GSB_DECLARATION(name, ...) void name(GSB_PARAMETERS(__VA_ARGS__), Stream);
GSB_CUDA_KERNELS(GSB_DECLARATION)
#undef GSB_DECLARATION

// Lists the splats of each tile, for `draw`: it reads the splats of `blend`, and their depths [C, N].
void list_tiles(const BlendArgs&, const float* depths, const TileLists&, Stream);

// Returns the bytes of scratch memory that `draw` needs for so many splats and tile intersections.
size_t draw_scratch(int64_t splats, int64_t room);

// The limits of `refine` (AGR): how many numbers the MLPs read, and how many one MLP changes.
constexpr int MAX_FEATURES = 7, MAX_WIDTH = 28;

// Returns the number of partial sums of the loss that `l1_ssim` writes.
int similarity_parts(int height, int width);

}  // namespace gsb::cuda
