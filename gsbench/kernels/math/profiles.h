// The two profiles of alpha over r^2 = d^T S^-1 d, with the offset d of a pixel from the mean of a projected Gaussian
// and the 2D covariance S: the Gaussian exp(-r^2 / 2), and the Beta profile (1 - r^2)^b of Universal Beta Splatting,
// with an exponent b > 0 for each Gaussian. Kernels are compiled for each profile, so that no pixel asks which it has.
#pragma once

#include "scalar.h"
#include "thresholds.h"

namespace gsb {
inline namespace GSB_ISA {

constexpr double HALF_LOG2_E = 0.7213475204444817;  // exp(-x/2) = 2^(-HALF_LOG2_E x)

struct Gaussian {
    static constexpr bool HAS_SHAPE = false;
    static constexpr int MOMENTS = 6;  // see FalloffMoments

    // Returns the largest r^2 at which alpha >= ALPHA_MIN.
    template <class T>
    GSB_HD static T reach(T opacity, T) {
        return log2(max(opacity * 255.0f, T(1.0f))) * T(1 / HALF_LOG2_E);
    }
};

struct Beta {
    static constexpr bool HAS_SHAPE = true;
    static constexpr int MOMENTS = 7;

    template <class T>
    GSB_HD static T reach(T opacity, T shape) {
        const T one(1.0f);
        // (1 - r^2)^b = e^(-b x), so that alpha = ALPHA_MIN at r^2 = 1 - e^-x; of a small x, by its series.
        const T x = min(log2(max(opacity * 255.0f, one)) * T(LN_2) / shape, T(EXPONENT_MAX));
        const T series = x * (one - x * (T(0.5f) - x * (1.0f / 6.0f)));
        return select(x < T(0.03f), series, one - exp(T(0.0f) - x));
    }
};

}  // namespace GSB_ISA
}  // namespace gsb
