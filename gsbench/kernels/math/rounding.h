// What float32 can make of the alpha of a projected Gaussian at a pixel: an interval that contains the result of
// math/blending.h for any rounding of its operations (running error analysis: Higham, Accuracy and Stability of
// Numerical Algorithms, section 3.3), computed in float64.
#pragma once

#include <cmath>

#include "profiles.h"

namespace gsb {
inline namespace GSB_ISA {

constexpr double U = 0x1p-24;  // the unit roundoff of float32
// The largest relative errors of exp2 and log2 of cpu/simd.h over all floats in (-20, 0] and in [1e-6, 1], which are
// 3.12 U and 5.83 U (v2, without fused products), rounded up.
constexpr double EXP2_ERROR = 3.5 * U, LOG2_ERROR = 6.5 * U;

// A projected Gaussian: its mean, the root of its inverse covariance (math/projection.h), opacity and exponent.
struct ExactSplat {
    double x, y, p, q, r, opacity, shape;
};

struct Interval {
    double low, high;
};

// The offset of a pixel from the mean, and its power w^2 + u^2.
struct ExactOffset {
    double dx, dy, w, u, power;

    ExactOffset(const ExactSplat& s, double x, double y) : dx(x - s.x), dy(y - s.y) {
        w = s.p * dx;
        u = s.q * dx + s.r * dy;
        power = w * w + u * u;
    }
};

// Returns the largest error of the power in float32, at any point that is at most `beside` pixels away along x and y.
inline double power_error(const ExactSplat& s, const ExactOffset& o, double beside = 0) {
    const double dx = std::abs(o.dx) + beside, dy = std::abs(o.dy) + beside;
    const double error_w = 2.01 * U * std::abs(s.p) * dx;
    const double error_u = 3.01 * U * (std::abs(s.q) * dx + std::abs(s.r) * dy);
    return 2 * (std::abs(o.w) * error_w + std::abs(o.u) * error_u) + error_w * error_w + error_u * error_u +
           2.01 * U * o.power;
}

// The falloff in float64 and its interval in float32, by profile. Both are before alpha is held below ALPHA_MAX.
template <class Profile>
struct ExactFalloff {
    static double value(const ExactSplat& s, const ExactOffset& o) { return s.opacity * std::exp2(-o.power); }

    static Interval single(const ExactSplat& s, const ExactOffset& o) {
        const double error = power_error(s, o), value = s.opacity * std::exp2(-o.power);
        const double grows = error < 1e-3 ? 1 + 0.7 * error : std::exp2(error);
        const double rounds = EXP2_ERROR + 2.01 * U;
        return {value / grows * (1 - rounds), value * grows * (1 + rounds)};
    }
};

template <>
struct ExactFalloff<Beta> {
    static constexpr double EXACT_SCALE = 1.38629436111989061883;  // 1 / (log2(e) / 2): r^2 of a power
    static constexpr double SINGLE_SCALE = 1.0f / HALF_LOG2_E, RIM = 1e-6;

    static double value(const ExactSplat& s, const ExactOffset& o) {
        const double r2 = o.power * EXACT_SCALE;
        if (r2 >= 1) return 0;
        return s.opacity * std::exp(s.shape * (r2 < 0.5 ? std::log1p(-r2) : std::log(std::fmax(1 - r2, RIM))));
    }

    static Interval single(const ExactSplat& s, const ExactOffset& o) {
        const double r2 = o.power * SINGLE_SCALE, error = power_error(s, o) * SINGLE_SCALE + 2.01 * U * r2;
        return {at(s, r2 + error, -1), at(s, r2 - error, 1)};
    }

private:
    // Returns the falloff at r^2, with all errors that follow in the direction of `sign`.
    static double at(const ExactSplat& s, double r2, double sign) {
        if (r2 >= 1) return 0;
        r2 = std::fmax(r2, 0);
        const double rest = std::fmax(1 - r2, RIM * (1 + sign * U));
        const double logarithm = rest < 0.5 ? std::log2(rest) : std::log1p(-r2) * 1.4426950408889634;
        // The logarithm of the rounded rest, and what is added for its rounding.
        const double error = (LOG2_ERROR + U) * std::abs(logarithm) + 2 * U * r2;
        const double exponent = s.shape * (logarithm + sign * error);
        return s.opacity * std::exp2(exponent + sign * 1.01 * U * std::abs(exponent)) *
               (1 + sign * (EXP2_ERROR + 2.01 * U));
    }
};

}  // namespace GSB_ISA
}  // namespace gsb
