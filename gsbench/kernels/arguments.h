// The arguments of the kernels, on the CPU and on a GPU: numbers and addresses of contiguous row-major arrays.
//
// Each structure holds the inputs of an operation, its outputs, the given gradients of its outputs, or the gradients of
// its inputs that the kernel computes. GSB_FIELDS after a structure says which of the four it is (INPUTS, OUTPUTS,
// GIVEN, GRADS) and lists its fields, which gsbench/kernels/operation.py fills by name. GSB_KERNELS lists the kernels
// that exist for both the CPU and a GPU.
//
// Arrays are over N Gaussians or over C cameras times N Gaussians. Scalars that a GPU computes are passed as addresses,
// so that the CPU does not wait to read them.
#pragma once

#include <cstdint>

#include "math/off_diagonal.h"
#include "math/sizes.h"

#ifndef GSB_FIELDS  // only bindings.h gives it a meaning
#define GSB_FIELDS(Structure, role, ...)
#endif

// Defines a structure whose fields are all arrays of floats, which the kernel writes (Written) or reads (Read).
#define GSB_ARRAYS(Structure, Type, role, ...) \
    struct Structure {                         \
        Type __VA_ARGS__;                      \
    };                                         \
    GSB_FIELDS(Structure, role, __VA_ARGS__)

namespace gsb {

using Written = float*;
using Read = const float*;

// ---- gsbench/kernels/slices.py

// On a GPU, a slice is computed for V views: `center` and `time` are [V, ..], and so are the outputs, [V, N, ..]. If
// `raw_per_view`, each view has raw parameters of its own, [V, N, ..], except for the opacities. On the CPU, V is 1.

// Gaussians of 6DGS and 7DGS: triangular factors over position p and direction d, time t or both, and the camera centre
// and time at which they are sliced.
struct TriangularArgs {
    int64_t N, V, conditioned;  // Gaussians from `conditioned` on are static (no camera or time changes them)
    bool raw_per_view;
    bool conditioned_first;
    OffDiagonal form;
    bool subtracts;  // use the method that forms covariances, for comparison (CPU only)
    float half;
    const float *means, *directions, *times;  // [N, 3] [N, 3] [N, 1]; one of the last two may be null
    const float *log_diagonal, *shape, *motion, *coupling;    // [N, k + 3] [N, 3] [N, 3 k] [N, k (k - 1) / 2]
    const float *opacities, *center;                          // [N] logits, [3]
    const float *time, *log_lambda_d, *log_lambda_t;          // [] [] []
    int threads;
};
GSB_FIELDS(TriangularArgs, INPUTS, N, V, conditioned, raw_per_view, conditioned_first, form, subtracts, half, means,
           directions, times, log_diagonal, shape, motion, coupling, opacities, center, time, log_lambda_d,
           log_lambda_t, threads)

// Those of Gaussians are added to; those of log_lambda_d and log_lambda_t are zero on entry.
GSB_ARRAYS(TriangularGrads, Written, GRADS, means, directions, times, log_diagonal, shape, motion, coupling, opacities,
           log_lambda_d, log_lambda_t)

// Gaussians of 4DGS over (x, y, z, t) with the factor M_left M_right diag(exp scales), and the time at which they are
// sliced.
struct RotatedArgs {
    int64_t N, V, conditioned;  // Gaussians from `conditioned` on are static
    bool raw_per_view;
    const float *means, *times, *scales, *left_quats, *right_quats;  // [N, 3] [N, 1] [N, 4] [N, 4] [N, 4]
    const float *opacities, *clock, *time, *log_lambda_t;            // [N] logits, [] [] []
    int threads;
};
GSB_FIELDS(RotatedArgs, INPUTS, N, V, conditioned, raw_per_view, means, times, scales, left_quats, right_quats,
           opacities, clock, time, log_lambda_t, threads)

// Those of Gaussians are added to; that of log_lambda_t is zero on entry.
GSB_ARRAYS(RotatedGrads, Written, GRADS, means, times, scales, left_quats, right_quats, opacities, log_lambda_t)

// The conditional 3D Gaussians (slice) for one camera and time: [N, 3] [N, 3, 3] [N].
GSB_ARRAYS(Observation, Written, OUTPUTS, means, factors, opacities)
GSB_ARRAYS(ObservationGrads, Read, GIVEN, means, factors, opacities)

// Gaussians of Universal Beta Splatting over position, direction and, unless `times` is null, time, with C = 3 or 4
// variables besides position, and the camera centre and time at which they are sliced.
struct UniversalArgs {
    int64_t N, V;
    bool raw_per_view;
    const float *means, *directions, *times;        // [N, 3] [N, 3] [N, 1]
    const float *scales, *skew, *lower, *betas;     // [N, 3 + C] [N, 3] [N, 3 C + C (C - 1) / 2] [N, 1 + C]
    const float *opacities, *center, *time;         // [N] logits, [3] []
    int threads;
};
GSB_FIELDS(UniversalArgs, INPUTS, N, V, raw_per_view, means, directions, times, scales, skew, lower, betas, opacities,
           center, time, threads)

// Added to.
GSB_ARRAYS(UniversalGrads, Written, GRADS, means, directions, times, scales, skew, lower, betas, opacities)

// A slice whose Gaussians have Beta profiles with the exponents `shapes`: [N, 3] [N, 3, 3] [N] [N].
GSB_ARRAYS(BetaSlice, Written, OUTPUTS, means, factors, opacities, shapes)
GSB_ARRAYS(BetaSliceGrads, Read, GIVEN, means, factors, opacities, shapes)

// Gaussians of 3DGS with the factor R diag(exp scales), which do not change with the camera or the time. V is 1 unless
// AGR has changed the raw parameters for each of several views.
struct StaticArgs {
    int64_t N, V;
    const float *scales, *quats, *opacities;  // [V, N, 3] [V, N, 4] [N] logits
    int threads;
};
GSB_FIELDS(StaticArgs, INPUTS, N, V, scales, quats, opacities, threads)

// [N, 3, 3] [N]
GSB_ARRAYS(StaticSlice, Written, OUTPUTS, factors, opacities)
GSB_ARRAYS(StaticSliceGrads, Read, GIVEN, factors, opacities)

// Added to.
GSB_ARRAYS(StaticGrads, Written, GRADS, scales, quats, opacities)

// Gaussians of dGS, and the camera centre and time of the view.
struct DirectArgs {
    int64_t N, V, conditioned;  // Gaussians from `conditioned` on are static
    bool raw_per_view;
    const float *means, *directions, *times, *scales, *quats;  // [N, 3] [N, 3] [N, 1] logits, [N, 3] logs, [N, 4]
    const float *precision, *coupling, *shares, *opacities;    // [N, 7] [N, 12] [N, 2] logits, [N] logits
    const float *center, *time;                                // [3] []
    int threads;
};
GSB_FIELDS(DirectArgs, INPUTS, N, V, conditioned, raw_per_view, means, directions, times, scales, quats, precision,
           coupling, shares, opacities, center, time, threads)

// Added to, as all gradients of this section below.
GSB_ARRAYS(DirectGrads, Written, GRADS, means, directions, times, scales, quats, precision, coupling, shares, opacities)

// Gaussians of dBS, which depend on K = 4 variables, or on 3 if `times` and `time` are null.
struct DirectBetaArgs {
    int64_t N, V, conditioned;
    bool raw_per_view;
    const float *means, *directions, *times, *scales, *skew;  // [N, 3] [N, 3] [N, 1] [N, 3] [N, 3]
    const float *precision, *coupling, *betas, *opacities;    // [N, 6 or 7] [N, 3 K] [N, 1 + K] [N] logits
    const float *center, *time;                               // [3] []
    int threads;
};
GSB_FIELDS(DirectBetaArgs, INPUTS, N, V, conditioned, raw_per_view, means, directions, times, scales, skew, precision,
           coupling, betas, opacities, center, time, threads)

GSB_ARRAYS(DirectBetaGrads, Written, GRADS, means, directions, times, scales, skew, precision, coupling, betas,
           opacities)

// Gaussians of FreeTimeGS or, if `plateaus` is not null, of SharpTimeGS.
struct FreeTimeArgs {
    int64_t N, V, conditioned;
    bool raw_per_view;
    const float *means, *times, *scales, *quats;                 // [N, 3] [N, 1] [N, 3] logs, [N, 4]
    const float *durations, *plateaus, *velocities, *opacities;  // [N, 1] logs, [N, 1] logs, [N, 3] [N] logits
    const float* time;                                           // []
    int threads;
};
GSB_FIELDS(FreeTimeArgs, INPUTS, N, V, conditioned, raw_per_view, means, times, scales, quats, durations, plateaus,
           velocities, opacities, time, threads)

GSB_ARRAYS(FreeTimeGrads, Written, GRADS, means, times, scales, quats, durations, plateaus, velocities, opacities)

// ---- gsbench/kernels/colors.py

// Inputs of colours: SH in the direction from `center` to the mean, times a Fourier series in time with `waves`
// frequencies. On a GPU, `center` and `time` are those of V views, and colours are [V, N, 3]; on the CPU, V is 1.
struct ColorArgs {
    int64_t N, V;
    bool gaussian_per_view, time_per_view;  // means and opacities are [V, N, ..]; times are [V, N, 1]
    int degree, bases, waves;        // bases: the number of harmonics stored for each frequency
    const float *sh0, *shN;          // [N, 1, 3] [N, waves * bases - 1, 3]
    const float *means, *opacities;  // [N, 3] [N]; colours are not computed for opacities below 1/255
    const float* times;              // [N, 1]; null if colours do not change with time
    const float *center, *time;      // [3] []
    const int32_t* orders;           // [N] each Gaussian's degree + 4 (waves - 1); null: all have the maximum
    int threads;
};
GSB_FIELDS(ColorArgs, INPUTS, N, V, gaussian_per_view, time_per_view, degree, bases, waves, sh0, shN, means, opacities,
           times, center, time, orders, threads)

// A colour channel that is clamped to zero is stored as -0, so that the backward pass recognises it without reading the
// coefficients again.
constexpr float CLAMPED = -0.0f;

// [N, 3]
GSB_ARRAYS(Colors, Written, OUTPUTS, colors)
GSB_ARRAYS(ShownColors, Read, OUTPUTS, colors)
GSB_ARRAYS(GivenColors, Read, GIVEN, colors)

struct ColorGrads {
    float *sh0, *shN;  // added to, in the rows that have a gradient
    float *means, *times;
};
GSB_FIELDS(ColorGrads, GRADS, sh0, shN, means, times)

// ---- gsbench/kernels/refine.py

// The `networks` MLPs of AGR, each with `features` inputs and HIDDEN hidden units, applied to every Gaussian. The first
// `networks - 1` arrays of values are their inputs. MLP number i changes array i; the last MLP changes all further
// arrays.
//
// On a GPU, Gaussians are changed for V views, and the kernel merges `units` and the encoded times `gamma` into the
// weights. On the CPU, V is 1, torch has merged them, `encoded` is 0, and `units` and `gamma` are null.
struct RefineArgs {
    int64_t N, V, refined;  // Gaussians from `refined` on are not changed
    int features, encoded, networks, arrays, outputs;  // features: inputs of the MLPs; outputs: the sum of widths
    int widths[MAX_NETWORKS], value_widths[MAX_VALUES];
    const float* values[MAX_VALUES];     // [arrays] of [N, value_widths]
    const float *weight_in, *bias_in;    // [networks * 64, features + encoded] [networks * 64]
    const float *weight_out, *bias_out;  // [outputs, 64] [outputs]
    const float *units, *gamma;          // [outputs] the sizes of inputs and outputs, [V, encoded]
    // [refined, 2] [V], or both null: outside of its interval of time a Gaussian is not changed (is_awake).
    const float *intervals, *time;
    int threads;
};
GSB_FIELDS(RefineArgs, INPUTS, N, V, refined, features, encoded, networks, arrays, outputs, widths, value_widths, values,
           weight_in, bias_in, weight_out, bias_out, units, gamma, intervals, time, threads)

struct Refined {
    float* values[MAX_VALUES];  // [arrays] of [V, N, value_widths]
};
GSB_FIELDS(Refined, OUTPUTS, values)

struct RefinedGrads {
    const float* values[MAX_VALUES];
};
GSB_FIELDS(RefinedGrads, GIVEN, values)

struct RefineGrads {
    float* values[MAX_VALUES];  // [N, value_widths]; null: an array that no MLP reads, whose gradient is that given
    float *weight_in, *bias_in, *weight_out, *bias_out;  // zero on entry
    float *scratch, *biases;  // [networks, V, refined, features] [V, networks * 64] zero on entry, on a GPU
};
GSB_FIELDS(RefineGrads, GRADS, values, weight_in, bias_in, weight_out, bias_out, scratch, biases)

// ---- gsbench/kernels/raster.py

struct ProjectArgs {
    int64_t N, C;
    bool gaussian_per_camera;                  // means, factors, opacities and shapes are [C, N, ..]
    const float *means, *factors, *opacities;  // [N, 3] [N, 3, 3] [N]
    const float *viewmats, *Ks;                // [C, 4, 4] [C, 3, 3]
    const float* shapes;                       // [N] exponents of Beta profiles; null: Gaussians
    int width, height;
    float near, far, eps2d;
    bool antialias;
    int threads;
};
GSB_FIELDS(ProjectArgs, INPUTS, N, C, gaussian_per_camera, means, factors, opacities, viewmats, Ks, shapes, width,
           height, near, far, eps2d, antialias, threads)

struct Splats {
    float* means2d;     // [C, N, 2]
    float* roots;       // [C, N, 4]: p, q, r of math/projection.h and the opacity
    float* depths;      // [C, N]
    float* half_sizes;  // [C, N, 2]; 0: culled
};
GSB_FIELDS(Splats, OUTPUTS, means2d, roots, depths, half_sizes)

// Depths null: zero.
GSB_ARRAYS(SplatGrads, Read, GIVEN, means2d, roots, depths)

struct ProjectGrads {
    float *means, *factors, *opacities;  // as the inputs
    float* viewmats;                     // [C, 4, 4], zero on entry; null: not wanted
};
GSB_FIELDS(ProjectGrads, GRADS, means, factors, opacities, viewmats)

struct BlendArgs {
    int64_t N, C;
    int D;
    bool color_per_camera, shape_per_camera;  // colors are [C, N, D], else [N, D]; likewise shapes
    const float *means2d, *roots, *half_sizes, *colors, *background;
    const int32_t *offsets, *ids;  // [C * tiles + 1] [pairs]: each tile's list of splats, front to back
    const float* shapes;           // [N] or [C, N] exponents of Beta profiles; null: Gaussians
    int width, height;
    int threads;
};
GSB_FIELDS(BlendArgs, INPUTS, N, C, D, color_per_camera, shape_per_camera, means2d, roots, half_sizes, colors,
           background, offsets, ids, shapes, width, height, threads)

struct Picture {
    float *image, *alpha;         // [C, H, W, D] [C, H, W, 1]
    float *transmittance, *stop;  // [C, tiles * 256]; `stop`: list position at which a pixel ended
};
GSB_FIELDS(Picture, OUTPUTS, image, alpha, transmittance, stop)

GSB_ARRAYS(BlendState, Read, OUTPUTS, transmittance, stop)

// Alpha null: zero.
GSB_ARRAYS(PictureGrads, Read, GIVEN, image, alpha)

struct BlendGrads {
    float *means2d, *roots, *colors;  // [C, N, 2] [C, N, 4] as colors
    float* background;                // [D], zero on entry; null: not wanted
    float* shapes;                    // as shapes; null: Gaussians
    float* scratch;                   // [C, N, moments + D] zero on entry, on a GPU
};
GSB_FIELDS(BlendGrads, GRADS, means2d, roots, colors, background, shapes, scratch)

// Bit k of `flags` is set if the k-th array has a value that is not finite or out of range.
struct ValueArgs {
    int64_t N, C, all_colors;  // N: the size of `opacities`; all_colors: the size of `colors`
    int D;
    const float *means, *factors, *opacities, *colors, *viewmats, *Ks, *background;
    const float* shapes;  // [N]; may be null
    int threads;
};
GSB_FIELDS(ValueArgs, INPUTS, N, C, all_colors, D, means, factors, opacities, colors, viewmats, Ks, background, shapes,
           threads)

struct ValueFlags {
    int64_t* flags;  // [1], zero on entry
};
GSB_FIELDS(ValueFlags, OUTPUTS, flags)

// ---- gsbench/kernels/loss.py

struct SimilarityArgs {
    int C, height, width;         // C images
    const float *image, *target;  // [C, H, W, 3]
    const uint8_t* target_bytes;  // [C, H, W, 3], 255 times the target; one of the two targets is null
    float ssim_weight;
    int threads;
};
GSB_FIELDS(SimilarityArgs, INPUTS, C, height, width, image, target, target_bytes, ssim_weight, threads)

struct SimilarityLoss {
    float* loss;      // [C, parts] partial sums of each image's loss, as many as `similarity_parts` returns
    float* gradient;  // [C, H, W, 3]; null: not wanted
    float* scratch;   // [C, 3, 3, H, W], on a GPU, for the gradient
};
GSB_FIELDS(SimilarityLoss, OUTPUTS, loss, gradient, scratch)

// ---- gsbench/kernels/adam.py

// Adam updates several parameters: all their numbers, or only the rows that `drawn` selects.
struct AdamArgs {
    int count;
    int64_t numbers[MAX_ADAM], widths[MAX_ADAM];         // of each parameter; of each of its rows
    const bool* drawn[MAX_ADAM];                         // [numbers / widths]; null: all rows
    const float *gradients[MAX_ADAM], *rates[MAX_ADAM];  // [numbers]; []
    const float* skip;                                   // []: nothing is updated unless it is 0; may be null
    double beta1, beta2, eps;
    int threads;
};
GSB_FIELDS(AdamArgs, INPUTS, count, numbers, widths, drawn, gradients, rates, skip, beta1, beta2, eps, threads)

struct AdamState {
    float *parameters[MAX_ADAM], *means[MAX_ADAM], *squares[MAX_ADAM];  // [numbers]
    float* steps[MAX_ADAM];                                             // []: updates of the parameter so far
};
GSB_FIELDS(AdamState, OUTPUTS, parameters, means, squares, steps)

// Whether several arrays are finite.
struct FiniteArgs {
    int count;
    int64_t numbers[MAX_ADAM];
    const float* arrays[MAX_ADAM];  // [numbers]
    int threads;
};
GSB_FIELDS(FiniteArgs, INPUTS, count, numbers, arrays, threads)

// What is finite changes neither.
struct ArrayFlags {
    float* flags;  // [count]: 1 if the array has a number that is not finite
    float* skip;   // []: 1 if any array has
};
GSB_FIELDS(ArrayFlags, OUTPUTS, flags, skip)

}  // namespace gsb

// kernel(name, the structures it takes)
#define GSB_KERNELS(kernel)                                                                    \
    kernel(slice_triangular, TriangularArgs, Observation)                                      \
    kernel(slice_triangular_backward, TriangularArgs, ObservationGrads, TriangularGrads)       \
    kernel(slice_rotated, RotatedArgs, Observation)                                            \
    kernel(slice_rotated_backward, RotatedArgs, ObservationGrads, RotatedGrads)                \
    kernel(slice_universal, UniversalArgs, BetaSlice)                                          \
    kernel(slice_universal_backward, UniversalArgs, BetaSliceGrads, UniversalGrads)            \
    kernel(slice_static, StaticArgs, StaticSlice)                                              \
    kernel(slice_static_backward, StaticArgs, StaticSliceGrads, StaticGrads)                   \
    kernel(slice_direct, DirectArgs, Observation)                                              \
    kernel(slice_direct_backward, DirectArgs, ObservationGrads, DirectGrads)                   \
    kernel(slice_direct_beta, DirectBetaArgs, BetaSlice)                                       \
    kernel(slice_direct_beta_backward, DirectBetaArgs, BetaSliceGrads, DirectBetaGrads)        \
    kernel(slice_free_time, FreeTimeArgs, Observation)                                         \
    kernel(slice_free_time_backward, FreeTimeArgs, ObservationGrads, FreeTimeGrads)            \
    kernel(show_colors, ColorArgs, Colors)                                                     \
    kernel(show_colors_backward, ColorArgs, ShownColors, GivenColors, ColorGrads)              \
    kernel(refine, RefineArgs, Refined)                                                        \
    kernel(refine_backward, RefineArgs, RefinedGrads, RefineGrads)                             \
    kernel(project, ProjectArgs, Splats)                                                       \
    kernel(project_backward, ProjectArgs, SplatGrads, ProjectGrads)                            \
    kernel(blend, BlendArgs, Picture)                                                          \
    kernel(blend_backward, BlendArgs, BlendState, PictureGrads, BlendGrads)                    \
    kernel(flag_values, ValueArgs, ValueFlags)                                                 \
    kernel(l1_ssim, SimilarityArgs, SimilarityLoss)                                            \
    kernel(adam_all, AdamArgs, AdamState)                                                      \
    kernel(flag_arrays, FiniteArgs, ArrayFlags)

// const A&, const B&, .. of the structures A, B, ..
#define GSB_CONST_1(A) const A&
#define GSB_CONST_2(A, B) const A&, const B&
#define GSB_CONST_3(A, B, C) const A&, const B&, const C&
#define GSB_CONST_4(A, B, C, D) const A&, const B&, const C&, const D&
#define GSB_CONST_5(A, B, C, D, E) const A&, const B&, const C&, const D&, const E&
#define GSB_PICK(_1, _2, _3, _4, _5, picked, ...) picked
#define GSB_PARAMETERS(...) \
    GSB_PICK(__VA_ARGS__, GSB_CONST_5, GSB_CONST_4, GSB_CONST_3, GSB_CONST_2, GSB_CONST_1)(__VA_ARGS__)
