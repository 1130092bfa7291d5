// What the CPU kernels take: plain arrays, row-major and contiguous; and the table that each instruction set fills.
#pragma once

#include <cstdint>

#include "../math/adam.h"
#include "../math/off_diagonal.h"
#include "../slices.h"

namespace gsb {

// Gaussians before cameras. N Gaussians, C cameras; gradients are named grad_ and may be null where said so.
struct ProjectArgs {
    int64_t N, C;
    const float *means, *factors, *opacities;  // [N, 3] [N, 3, 3] [N]
    const float *viewmats, *Ks;                // [C, 4, 4] [C, 3, 3]
    int width, height;
    float near, far, eps2d;
    bool antialias;
    int threads;
};

struct Splats {
    float *means2d, *roots, *opacities, *depths, *half_sizes;  // [C, N, 2] [C, N, 3] [C, N] [C, N] [C, N, 2]
};

struct ProjectGrads {
    float *means, *factors, *opacities;
    float* viewmats;  // null: not wanted
};

struct BinArgs {
    int64_t N, C;
    const float *means2d, *depths, *half_sizes;
    int width, height;
    int threads;
};

struct BlendArgs {
    int64_t N, C;
    int D;
    bool color_per_camera;  // colors are [C, N, D], else [N, D]
    const float *means2d, *roots, *opacities, *half_sizes, *colors, *background;
    const int64_t* offsets;  // [C * tiles + 1]
    const int32_t* ids;      // [pairs] the Gaussians of a tile, front to back
    int width, height;
    int threads;
};

struct Picture {
    float *image, *alpha;         // [C, H, W, D] [C, H, W]
    float *transmittance, *stop;  // [C, tiles, 256], 4x4 blocks of pixels: what is left; how far into the tile's list
};

struct BlendGrads {
    const float *image, *alpha;  // of the picture
    float *means2d, *roots, *opacities, *colors, *background;
};

struct SimilarityArgs {
    int height, width;
    const float *image, *target;  // [H, W, 3]
    float ssim_weight;
    float* grad;  // [H, W, 3], null: not wanted
    int threads;
};

// Gaussians with a triangular factor over (p, d) or (p, t, d), observed from a place and at a time (6DGS, 7DGS).
struct TriangularArgs {
    int64_t N;
    bool conditioned_first;
    OffDiagonal form;
    bool subtracts;  // by the scheme that forms S, for comparison
    float half, lambda_d, lambda_t, time, center[3];
    const float *means, *directions, *times;  // [N, 3] [N, 3] [N], null: time is not observed
    const float *log_diagonal, *shape, *motion, *coupling;  // [N, k + 3] [N, 3] [N, 3 k] [N, k (k - 1) / 2]
    const float* opacities;                                 // [N] logits
    int threads;
};

struct TriangularGrads {
    float *means, *directions, *times, *log_diagonal, *shape, *motion, *coupling, *opacities;
    float lambdas[2];  // of direction and time
};

// Gaussians over (x, y, z, t) with the factor M_left M_right diag(exp scales), observed at a time (4DGS).
struct RotatedArgs {
    int64_t N;
    float lambda_t, time;
    const float *means, *times, *scales, *left, *right, *opacities;  // [N, 3] [N] [N, 4] [N, 4] [N, 4] [N] logits
    int threads;
};

struct RotatedGrads {
    float *means, *times, *scales, *left, *right, *opacities;
    float lambda_t;
};

// 3D Gaussians with the factor R diag(exp scales), which are their own slice (3DGS).
struct StillArgs {
    int64_t N;
    const float *scales, *quats, *opacities;  // [N, 3] [N, 4] [N] logits
    int threads;
};

// Colours by spherical harmonics in the direction from `center`, times `waves` frequencies of time.
struct ColorArgs {
    int64_t N;
    int degree, bases, waves;        // bases: harmonics stored for each frequency
    const float *sh0, *shN;          // [N, 3] [N, waves * bases - 1, 3]
    const float *means, *opacities;  // [N, 3] [N]: one below 1/255 is not drawn, and has no colour
    const float* times;              // [N], null: colours do not change
    float time, center[3];
    int threads;
};

struct ColorGrads {
    const float* colors;
    float *sh0, *shN, *means, *times;
    bool by_rows;         // only these Gaussians have a gradient, and shN has a row for each of them:
    const int64_t* rows;  // [count] ascending
    int64_t count;
};

// Perceptrons features x 64 x width, one for each of `networks`, on every Gaussian (AGR). They read the values of the
// first `networks - 1` arrays, each of which one of them moves; the last moves all the others.
struct RefineArgs {
    int64_t N;
    int features_width, networks, arrays, outputs;  // outputs: the sum of widths, and of value_widths
    const int *widths, *value_widths;               // [networks] [arrays]
    const float* const* values;                     // [arrays] of [N, value_widths]
    const float *weight_in, *bias_in;    // [networks * 64, features_width] [networks * 64]
    const float *weight_out, *bias_out;  // [outputs, 64] [outputs]
    int threads;
};

struct RefineGrads {
    float* const* features;  // [networks - 1] of [N, value_widths]
    float *weight_in, *bias_in, *weight_out, *bias_out;
};

// Adam on the rows [N, width] of a parameter that are `drawn`.
struct AdamArgs {
    int64_t N, width;
    const bool* drawn;                    // [N]
    const float* gradients;               // [N, width], as are ..
    float *parameters, *means, *squares;  // .. the values, and Adam's moments
    AdamRule rule;
    int threads;
};

struct Kernels {
    const char* isa;
    void (*project)(const ProjectArgs&, const Splats&);
    void (*project_backward)(const ProjectArgs&, const Splats& grads, const ProjectGrads&);
    int64_t (*count_tiles)(const BinArgs&, int64_t* offsets);
    void (*fill_tiles)(const BinArgs&, const int64_t* offsets, int32_t* ids);
    void (*blend)(const BlendArgs&, const Picture&);
    void (*blend_backward)(const BlendArgs&, const Picture&, const BlendGrads&);
    double (*l1_ssim)(const SimilarityArgs&);
    void (*observe_triangular)(const TriangularArgs&, const Observation&);
    void (*observe_triangular_backward)(const TriangularArgs&, const Observation& grads, TriangularGrads&);
    void (*observe_rotated)(const RotatedArgs&, const Observation&);
    void (*observe_rotated_backward)(const RotatedArgs&, const Observation& grads, RotatedGrads&);
    void (*observe_still)(const StillArgs&, const StillSlice&);
    void (*observe_still_backward)(const StillArgs&, const StillSlice& grads, const StillGrads&);
    void (*show_colors)(const ColorArgs&, float* colors);
    void (*show_colors_backward)(const ColorArgs&, const ColorGrads&);
    void (*refine)(const RefineArgs&, float* const* out);
    void (*refine_backward)(const RefineArgs&, const float* const* grads, const RefineGrads&);
    void (*adam)(const AdamArgs&);
    float (*roofline_flops)(int64_t rounds);
    void (*roofline_triad)(float* a, const float* b, const float* c, int64_t n);
    float (*roofline_alphas)(int64_t rounds);
};

constexpr int TILE = 16;  // pixels a side
inline int tiles_along(int pixels) { return (pixels + TILE - 1) / TILE; }

}  // namespace gsb
