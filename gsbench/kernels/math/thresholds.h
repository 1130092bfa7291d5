// Thresholds of slicing and blending. gsbench/kernels/headers.py reads these lines, so that the torch implementation
// uses the same values.
#pragma once

namespace gsb {

// The largest absolute log size; a larger one acts as this one. Without a limit, Adam would increase the log size of a
// Gaussian forever if no view shows its end, as for a static one. e^+-16 = 1e+-7 is practically infinite or zero, and
// its square still fits into float32.
constexpr float LOG_SIZE_MAX = 16.0f;
// An exponent of the opacity beyond this is treated as infinite: exp(-80) = 2e-35.
constexpr float EXPONENT_MAX = 80.0f;
// A 4D Gaussian is culled unless its f_temp is above this (4DGS, gaussian_renderer).
constexpr float TIME_OPACITY_FACTOR_MIN = 0.05f;
// A Gaussian with an alpha below ALPHA_MIN is skipped (3DGS, forward.cu), and alpha is clamped to ALPHA_MAX (gsplat;
// 3DGS: 0.99). Blending of a pixel ends before its transmittance would fall below TRANSMITTANCE_MIN.
constexpr float ALPHA_MIN = 1.0f / 255.0f;
constexpr float ALPHA_MAX = 0.999f;
constexpr float TRANSMITTANCE_MIN = 1e-4f;
// 1 - r^2 of a Beta profile is held above this in alpha and in its gradient, which for exponents below 1 is infinite at
// the rim r = 1.
constexpr double RIM_MIN = 1e-6;
// lambda_o of dGS, the coefficient in the exponent of its opacity factor.
constexpr float DIRECT_FADING = 0.35f;
// The least ln(1 - tanh) in an opacity factor of UBS and dBS: ln 1.2e-7, as in the authors' code.
constexpr float BETA_LOG_MIN = -15.9357738f;

}  // namespace gsb
