// The arguments of the kernels of gsbench/kernels/slices.py: slices of dGS, dBS, FreeTimeGS, SharpTimeGS. See arguments.h, which
// includes this file.
#pragma once

namespace gsb {

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

// All gradients of this section are added to.
struct DirectGrads {
    float *means, *directions, *times, *scales, *quats, *precision, *coupling, *shares, *opacities;
};
GSB_FIELDS(DirectGrads, GRADS, means, directions, times, scales, quats, precision, coupling, shares, opacities)

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

struct DirectBetaGrads {
    float *means, *directions, *times, *scales, *skew, *precision, *coupling, *betas, *opacities;
};
GSB_FIELDS(DirectBetaGrads, GRADS, means, directions, times, scales, skew, precision, coupling, betas, opacities)

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

struct FreeTimeGrads {
    float *means, *times, *scales, *quats, *durations, *plateaus, *velocities, *opacities;
};
GSB_FIELDS(FreeTimeGrads, GRADS, means, times, scales, quats, durations, plateaus, velocities, opacities)

}  // namespace gsb
