// Where the mathematics of a slice stops following a number further, and where blending stops.
// gsbench/kernels/headers.py reads these lines, so that torch's twin of the kernels stops at the same places.
#pragma once

namespace gsb {

// Adam's steps of 0.05 on a logarithm have no end where the gradient has none, as for a scale that is infinite for all
// one can see. A logarithm beyond acts as this one does: e^+-16 = 1e+-7 is as good as infinite or zero, and its square
// is a float32.
constexpr float LOG_SIZE_MAX = 16.0f;
// exp(-80) = 2e-35: beyond, nothing is left of a Gaussian.
constexpr float EXPONENT_MAX = 80.0f;
// A 4D Gaussian whose f_temp is not above this is not drawn (4DGS, gaussian_renderer).
constexpr float TIME_OPACITY_FACTOR_MIN = 0.05f;
// An alpha below this is skipped, one above that held (3DGS, forward.cu); a pixel is full where less than
// TRANSMITTANCE_MIN of the light behind would be left.
constexpr float ALPHA_MIN = 1.0f / 255.0f;
constexpr float ALPHA_MAX = 0.999f;
constexpr float TRANSMITTANCE_MIN = 1e-4f;

}  // namespace gsb
