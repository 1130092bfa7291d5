// What the CUDA kernels take: device pointers, row-major and contiguous, and the stream to run on.
//
// Every function only enqueues work. Memory is the caller's, outputs and scratch alike, so that it comes from torch's
// caching allocator. N Gaussians before C cameras give C x N splats; gradients are named g_ and may be null where said.
#pragma once

#include <cstddef>
#include <cstdint>

#include "../math/off_diagonal.h"
#include "../slices.h"

struct CUstream_st;

namespace gsb::cuda {

using Stream = CUstream_st*;

struct Cameras {
    int64_t C;
    const float *viewmats, *Ks;  // [C, 4, 4] [C, 3, 3]
    int width, height;
    float near, far, eps2d;
    bool antialias;
};

struct Gaussians {
    int64_t N;
    const float *means, *factors, *opacities;  // [N, 3] [N, 3, 3] [N]
};

struct GaussianGrads {
    float *means, *factors, *opacities;
    float* viewmats;  // [C, 4, 4], zero on entry; null: not wanted
};

struct Splats {
    float* means2d;     // [C, N, 2]
    float* roots;       // [C, N, 4]: p, q, r of math/projection.h and the opacity
    float* depths;      // [C, N]
    float* half_sizes;  // [C, N, 2], 0: not drawn
};

struct SplatGrads {
    const float *means2d, *roots, *depths;  // null: zero
};

// Splats to each tile's list. `order` are splats by depth, `ends` the running sum of the tiles they touch.
struct BinArgs {
    int64_t N, C;
    const float *means2d, *roots, *depths, *half_sizes;
    int width, height;
};

struct BlendArgs {
    int64_t N, C;
    int D;
    bool color_per_camera;  // colors are [C, N, D], else [N, D]
    const float *means2d, *roots, *colors, *background;
    const int32_t *offsets, *ids;  // [C * tiles + 1] [pairs]
    int width, height;
};

struct Picture {
    float *image, *alpha;  // [C, H, W, D] [C, H, W]
    float* transmittance;  // [C, H, W] behind the last splat that counts ..
    int32_t* stop;         // .. whose place in the tile's list this is, plus one
};

struct BlendGrads {
    const float *image, *alpha;  // of the picture; null: zero
    float* sums;                 // [C, N, 6 + D] scratch, zero on entry: moments and colours
    float *means2d, *roots;      // [C, N, 2] [C, N, 4]
    float* colors;               // as the colours
};

struct SimilarityArgs {
    int height, width;
    const float *image, *target;  // [H, W, 3]
    float ssim_weight;
    float* loss;         // [blocks]: its parts, to be added up
    float* derivatives;  // [3, 3, H, W] scratch; null: no gradient wanted
    float* grad;         // [H, W, 3]
};

// Gaussians with a triangular factor over (p, d) or (p, t, d), observed from a place and at a time (6DGS, 7DGS).
struct TriangularArgs {
    int64_t N;
    bool conditioned_first;
    OffDiagonal form;
    float half;
    const float *time, *lambda_d, *lambda_t, *center;  // [1] [1] [1] [3]
    const float *means, *directions, *times;           // [N, 3] [N, 3] [N], null: time is not observed
    const float *log_diagonal, *shape, *motion, *coupling;  // [N, k + 3] [N, 3] [N, 3 k] [N, k (k - 1) / 2]
    const float* opacities;                                 // [N] logits
};

struct TriangularGrads {
    float *means, *directions, *times, *log_diagonal, *shape, *motion, *coupling, *opacities;
    float* lambdas;  // [2] of direction and time, zero on entry
};

// 4D Gaussians with factor M_left M_right diag(exp scales), observed at a time (4DGS).
struct RotatedArgs {
    int64_t N;
    const float *time, *lambda_t;                                      // [1] [1]
    const float *means, *times, *scales, *left, *right, *opacities;  // [N, 3] [N] [N, 4] [N, 4] [N, 4] [N] logits
};

struct RotatedGrads {
    float *means, *times, *scales, *left, *right, *opacities;
    float* lambda_t;  // [1], zero on entry
};

// 3D Gaussians with the factor R diag(exp scales), which are their own slice (3DGS).
struct StillArgs {
    int64_t N;
    const float *scales, *quats, *opacities;  // [N, 3] [N, 4] [N] logits
};

// Colours by spherical harmonics in the direction from `center`, times `waves` frequencies of time.
struct ColorArgs {
    int64_t N;
    int degree, bases, waves;        // bases: harmonics stored for each frequency
    const float *sh0, *shN;          // [N, 3] [N, waves * bases - 1, 3]
    const float *means, *opacities;  // [N, 3] [N]: one below 1/255 is not drawn, and has no colour
    const float* times;              // [N], null: colours do not change
    const float *center, *time;      // [3] [1]
};

struct ColorGrads {
    const float* colors;
    float *sh0, *shN, *means, *times;  // zero on entry
};

// Perceptrons features x 64 x width, one for each of `networks`, on every Gaussian (AGR).
constexpr int MAX_NETWORKS = 4, MAX_FEATURES = 8, MAX_WIDTH = 28;

// A column of a value [N, stride]: what is read, and where what comes of it goes.
struct Column {
    const float* from;
    float* to;
    int64_t stride;
};

struct RefineArgs {
    int64_t N;
    int features_width, networks, outputs;  // outputs: the sum of widths
    int widths[MAX_NETWORKS];
    Column features[MAX_FEATURES];              // what the networks read; `to` its gradient, which is added to
    Column moved[MAX_NETWORKS][MAX_WIDTH];      // what each network moves; backward: `from` the outputs' gradient
    const float *weight_in, *bias_in;           // [networks * 64, features_width] [networks * 64]
    const float *weight_out, *bias_out;         // [outputs, 64] [outputs]
};

struct RefineGrads {
    float* features;                                     // [networks, N, features_width] scratch
    float *weight_in, *bias_in, *weight_out, *bias_out;  // zero on entry
};

// Adam on the rows [N, width] of a parameter that are `drawn`.
struct AdamArgs {
    int64_t N, width;
    const bool* drawn;                    // [N]
    const float* gradients;               // [N, width], as are ..
    float *parameters, *means, *squares;  // .. the values, and Adam's moments
    float rate, beta1, beta2, log_beta1, log_beta2, eps;
    const float* step;  // [1], from 1
};
void adam(const AdamArgs&, Stream);

// Bit k of `flags` is set where the k-th array has a value that is not finite, or out of range: means, factors,
// opacities, colors, viewmats, Ks, background.
struct Values {
    int64_t N, C, colors;
    int D;
    const float *means, *factors, *opacities, *color, *viewmats, *Ks, *background;
};
void flag_values(const Values&, int64_t* flags, Stream);

void project(const Gaussians&, const Cameras&, const Splats&, Stream);
void project_backward(const Gaussians&, const Cameras&, const SplatGrads&, const GaussianGrads&, Stream);

// keys, indices, sorted_keys, order: [splats]; ends: [splats]
void count_tiles(const BinArgs&, uint32_t* keys, uint32_t* indices, uint32_t* sorted_keys, uint32_t* order,
                 int64_t* ends, void* scratch, size_t scratch_bytes, Stream);
// tiles, splats, sorted_tiles, ids: [pairs]; offsets: [C * tiles + 1]. Where `pairs` is not the last of `ends`, but the
// room there is, `tiles` are 0xffffffff on entry, and pairs beyond it are left out.
void fill_tiles(const BinArgs&, const uint32_t* order, const int64_t* ends, int64_t pairs, uint32_t* tiles,
                uint32_t* splats, uint32_t* sorted_tiles, uint32_t* ids, int32_t* offsets, void* scratch,
                size_t scratch_bytes, Stream);

void blend(const BlendArgs&, const Picture&, Stream);
// `by_splat`: with a splat a lane, else with a pixel a lane; the same gradients.
void blend_backward(const BlendArgs&, const Picture&, const BlendGrads&, bool by_splat, Stream);

void observe_triangular(const TriangularArgs&, const Observation&, Stream);
void observe_triangular_backward(const TriangularArgs&, const Observation& grads, const TriangularGrads&, Stream);

void observe_rotated(const RotatedArgs&, const Observation&, Stream);
void observe_rotated_backward(const RotatedArgs&, const Observation& grads, const RotatedGrads&, Stream);

void observe_still(const StillArgs&, const StillSlice&, Stream);
void observe_still_backward(const StillArgs&, const StillSlice& grads, const StillGrads&, Stream);

void show_colors(const ColorArgs&, float* colors, Stream);
void show_colors_backward(const ColorArgs&, const ColorGrads&, Stream);

void refine(const RefineArgs&, Stream);
void refine_backward(const RefineArgs&, const RefineGrads&, Stream);

int similarity_blocks(int height, int width);
void l1_ssim(const SimilarityArgs&, Stream);

}  // namespace gsb::cuda
