// The CPU kernels: those of arguments.h, kernels that exist only on the CPU, and the table of kernels of each
// instruction set.
#pragma once

#include <cstdint>

#include "../arguments.h"

namespace gsb {

inline int tiles_along(int pixels) { return (pixels + TILE - 1) / TILE; }

struct BinArgs {
    int64_t N, C;
    const float *means2d, *depths, *half_sizes;
    int width, height;
    int threads;
};
GSB_FIELDS(BinArgs, INPUTS, N, C, means2d, depths, half_sizes, width, height, threads)

struct TileOffsets {
    int32_t* offsets;  // [C * tiles + 1] where each tile's list begins
    int64_t* pairs;    // [1] how long all lists are, which may be more than an offset can say
};
GSB_FIELDS(TileOffsets, OUTPUTS, offsets, pairs)

struct TileLists {
    const int32_t* offsets;
    int32_t* ids;  // [pairs] a camera's Gaussians, front to back
};
GSB_FIELDS(TileLists, OUTPUTS, offsets, ids)

// Gaussians in float64, the same in float32 as one camera projects them (Splats of arguments.h), and the camera.
struct ExactProjectArgs {
    int64_t N;
    const double *means, *factors, *opacities, *shapes;  // [N, 3] [N, 3, 3] [N] [N] (null: Gaussians)
    const float *means2d, *roots, *depths, *half_sizes, *single_shapes;  // of one camera; single_shapes: [N] or null
    const float *viewmats, *Ks;  // [4, 4] [3, 3]
    int width, height;
    double near, far, eps2d;
    bool antialias;
    int threads;
};
GSB_FIELDS(ExactProjectArgs, INPUTS, N, means, factors, opacities, shapes, means2d, roots, depths, half_sizes,
           single_shapes, viewmats, Ks, width, height, near, far, eps2d, antialias, threads)

// A Gaussian that is projected in float64 and in float32, in two cache lines.
struct alignas(64) ExactRecord {
    double exact[7], depth;  // x, y, p, q, r of math/projection.h, opacity, exponent
    double half_x;           // 0: culled
    double depth_error;      // of float32
    float single[7], single_half_x, single_half_y;  // as in float64
    bool sure;                                      // whether float32 surely draws it
};
static_assert(sizeof(ExactRecord) == 128);

struct ExactSplats {
    ExactRecord* records;                  // [N]
    float *means2d, *half_sizes, *depths;  // [N, 2] [N, 2] [N]: boxes that contain those of float64 and float32
};
GSB_FIELDS(ExactSplats, OUTPUTS, records, means2d, half_sizes, depths)

// The Gaussians of `exact_splats` with their colours, to render the exact image.
struct ExactArgs {
    int D;
    bool beta;
    const ExactRecord* records;    // [N]
    const double* colors;          // [N, D]
    const float *single_colors, *background;  // [N, D] [D]
    const int32_t *offsets, *ids;  // each tile's list, by depths in float64 that are rounded to float32
    int width, height;
    int threads;
};
GSB_FIELDS(ExactArgs, INPUTS, D, beta, records, colors, single_colors, background, offsets, ids, width, height,
           threads)

struct ExactPicture {
    double *image, *bound;  // [H, W, D] [H, W]: the largest error of a channel of the image in float32
    int32_t* culprit;       // [H, W] the Gaussian with the largest share of the bound; -1: none
    uint8_t* branches;      // [H, W] what float32 may decide otherwise, a sum of Branch
};
GSB_FIELDS(ExactPicture, OUTPUTS, image, bound, culprit, branches)

enum Branch : uint8_t { SKIPPED = 1, STOPPED = 2, ORDERED = 4 };  // alpha at 1/255, or culling; the early stop; equal depths

// A layer of a network, y = W x + b, of rows x; on a GPU torch computes it.
struct LinearArgs {
    int64_t N;
    int C, K;
    const float *x, *weight, *bias;  // [N, C] [K, C] [K]
    bool relu;                       // y = max(0, W x + b)
    int threads;
};
GSB_FIELDS(LinearArgs, INPUTS, N, C, K, x, weight, bias, relu, threads)

// [N, K]
GSB_ARRAYS(Layer, Written, OUTPUTS, y)
GSB_ARRAYS(LayerState, Read, OUTPUTS, y)
GSB_ARRAYS(LayerGrads, Read, GIVEN, y)

// Zero on entry; x null: not wanted.
GSB_ARRAYS(LinearGrads, Written, GRADS, x, weight, bias)

// Planes of features over two of the axes x, y, z, read at points; on a GPU torch samples them.
constexpr int MOST_LEVELS = 8;

struct PlaneArgs {
    int64_t N;
    int C, levels, x, y, z;                 // nodes along each axis in the first level; the next has twice as many
    const float *positions, *first, *last;  // [N, 3] [3] [3] of the points, of the first and the last nodes
    const float* of_space;                  // [M, C] nodes
    int threads;
};
GSB_FIELDS(PlaneArgs, INPUTS, N, C, levels, x, y, z, positions, first, last, of_space, threads)

// [N, levels C]
GSB_ARRAYS(Products, Written, OUTPUTS, products)
GSB_ARRAYS(ProductGrads, Read, GIVEN, products)

// Those of nodes are zero on entry.
GSB_ARRAYS(PlaneGrads, Written, GRADS, positions, of_space)

// Products of samples in space, planes over one of the axes x, y, z and time, and a network that reads F = levels C
// features: a layer of H numbers with ReLU, and heads of one more such layer and a layer without ReLU each. Head h has the
// outputs from ends[h - 1] to ends[h] of all K, in N rows of their own.
struct FieldArgs {
    int64_t N;
    int C, levels, x, y, z, t, F, H, heads, K;
    const float *products, *positions, *first, *last;  // [N, F] and as in PlaneArgs
    const float *time, *of_time;                       // [] in [-1, 1], [T, C] nodes
    const float *first_weight, *first_bias;            // [H, F] [H]
    const float *hidden_weight, *hidden_bias;          // [heads, H, H] [heads, H]
    const float *last_weight, *last_bias;              // [K, H] [K]
    const int32_t* ends;                               // [heads]
    int threads;
};
GSB_FIELDS(FieldArgs, INPUTS, N, C, levels, x, y, z, t, F, H, heads, K, products, positions, first, last, time, of_time,
           first_weight, first_bias, hidden_weight, hidden_bias, last_weight, last_bias, ends, threads)

// The first three are added to, those of the network are zero on entry.
GSB_ARRAYS(FieldGrads, Written, GRADS, products, positions, of_time, first_weight, first_bias, hidden_weight,
           hidden_bias, last_weight, last_bias)

// How rough these planes are along their rows, and how far from 1 those of time, with a weight for each.
struct PenaltyArgs {
    int C, levels, x, y, z, t;
    const float *of_space, *of_time;  // as in PlaneArgs and FieldArgs
    float space_smoothness, time_smoothness, time_sparsity;
    int threads;
};
GSB_FIELDS(PenaltyArgs, INPUTS, C, levels, x, y, z, t, of_space, of_time, space_smoothness, time_smoothness,
           time_sparsity, threads)

// []
GSB_ARRAYS(Penalty, Written, OUTPUTS, penalty)
GSB_ARRAYS(PenaltyGrad, Read, GIVEN, penalty)
GSB_ARRAYS(NodeGrads, Written, GRADS, of_space, of_time)

// Arrays to set to zero.
struct ZeroArgs {
    int count;
    int64_t numbers[MAX_ADAM];
    float* arrays[MAX_ADAM];  // [numbers]
    int threads;
};
GSB_FIELDS(ZeroArgs, INPUTS, count, numbers, arrays, threads)

}  // namespace gsb

#define GSB_CPU_KERNELS(kernel)                    \
    GSB_KERNELS(kernel)                            \
    kernel(count_tiles, BinArgs, TileOffsets)      \
    kernel(fill_tiles, BinArgs, TileLists)         \
    kernel(exact_splats, ExactProjectArgs, ExactSplats)\
    kernel(exact_image, ExactArgs, ExactPicture)   \
    kernel(linear, LinearArgs, Layer)              \
    kernel(linear_backward, LinearArgs, LayerState, LayerGrads, LinearGrads) \
    kernel(field, FieldArgs, Layer)                \
    kernel(field_backward, FieldArgs, LayerGrads, FieldGrads) \
    kernel(sample_planes, PlaneArgs, Products)     \
    kernel(sample_planes_backward, PlaneArgs, ProductGrads, PlaneGrads) \
    kernel(plane_penalty, PenaltyArgs, Penalty)    \
    kernel(plane_penalty_backward, PenaltyArgs, PenaltyGrad, NodeGrads) \
    kernel(zero_arrays, ZeroArgs)

namespace gsb {

struct Kernels {
    const char* isa;
#define GSB_MEMBER(name, ...) void (*name)(GSB_PARAMETERS(__VA_ARGS__));
    GSB_CPU_KERNELS(GSB_MEMBER)
#undef GSB_MEMBER
    float (*roofline_flops)(int64_t rounds);
    void (*roofline_triad)(float* a, const float* b, const float* c, int64_t n);
    float (*roofline_alphas)(int64_t rounds);
};

}  // namespace gsb
