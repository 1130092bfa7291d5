// What slices leave, on the CPU and on a GPU: row-major arrays, contiguous.
#pragma once

namespace gsb {

// The 3D Gaussians that an observation leaves, or their gradients.
struct Observation {
    float *means, *factors, *opacities;  // [N, 3] [N, 3, 3] [N]
};

// The same where means stay what they are.
struct StillSlice {
    float *factors, *opacities;  // [N, 3, 3] [N]
};

struct StillGrads {
    float *scales, *quats, *opacities;  // [N, 3] [N, 4] [N]
};

}  // namespace gsb
