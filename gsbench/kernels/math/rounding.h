// What float32 can make of the alpha of a projected Gaussian at pixels: intervals that contain the result of
// math/blending.h for any rounding of its operations (running error analysis: Higham, Accuracy and Stability of
// Numerical Algorithms, section 3.3). T is a SIMD vector of doubles.
#pragma once

#include "blending.h"

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

template <class T>
struct Interval {
    T low, high;
};

// Pixels in the coordinates u, w of math/blending.h, where u = u_x + u_y; their power is w^2 + u^2.
template <class T>
struct ExactOffset {
    T w, u_x, u_y, u, power;

    GSB_HD ExactOffset(const ExactSplat& s, T x, T y) {
        const T dx = x - s.x;
        w = dx * s.p;
        u_x = dx * s.q;
        u_y = (y - s.y) * s.r;
        u = u_x + u_y;
        power = w * w + u * u;
    }
};

// Returns the largest error of the power in float32. That of w is at most 2.01 U |w|, that of u 3.01 U (|u_x| + |u_y|).
template <class T>
GSB_HD inline T power_error(const ExactOffset<T>& o) {
    const T terms = abs(o.u_x) + abs(o.u_y);
    const T of_w = o.w * o.w * (4.02 * U + 4.05 * U * U);
    const T of_u = terms * (abs(o.u) * (6.02 * U) + terms * (9.07 * U * U));
    return of_w + of_u + o.power * (2.01 * U);
}

// The interval of the falloff in float32, by profile, before alpha is held below ALPHA_MAX. `exact` is the falloff in
// float64, and `power` its power.
template <class Profile>
struct SingleFalloff {
    // Where the powers of float64 and float32 hardly differ, the falloff of float64 gives that of float32: the series
    // of 2^x has a relative error of 1e-10 for |x| <= 0.01. Then 2^x <= 1 + 0.7 x; and 2^-x >= 1 - 0.7 x for all x.
    template <class T>
    GSB_HD static Interval<T> at(const ExactSplat& s, const ExactOffset<T>& o, T power, T exact, double opacity_ratio) {
        constexpr double rounds = EXP2_ERROR + 2.01 * U + 1e-10;
        const T error = power_error(o), more = power - o.power;
        T value = exact * opacity_ratio * (((more * 0.0555 + 0.24022650696) * more + LN_2) * more + 1.0);
        T grows = error * 0.7;
        if (!(opacity_ratio > 0) || any(max(abs(more), error) > T(0.01))) {
            value = exp2(-o.power) * s.opacity;
            grows = max(grows, exp2(error) - 1.0);
        }
        return {value * max(T(1.0) - grows, T(0.0)) * (1 - rounds), value * (grows + 1.0) * (1 + rounds)};
    }
};

template <>
struct SingleFalloff<Beta> {
    static constexpr double SCALE = static_cast<float>(1 / HALF_LOG2_E);

    template <class T>
    GSB_HD static Interval<T> at(const ExactSplat& s, const ExactOffset<T>& o, T, T, double) {
        const T r2 = o.power * SCALE, error = power_error(o) * SCALE + r2 * (2.01 * U);
        return {end(s, r2 + error, -1.0), end(s, r2 - error, 1.0)};
    }

private:
    // Returns the falloff at r^2, with all errors that follow in the direction of `sign`.
    template <class T>
    GSB_HD static T end(const ExactSplat& s, T r2, double sign) {
        const T inside = clamp(r2, T(0.0), T(1.0)), difference = T(1.0) - inside;
        const T rest = max(difference, T(RIM_MIN * (1 + sign * U)));
        const T logarithm = log2(rest) + ((T(1.0) - difference) - inside) * LOG2_E;
        // The logarithm of the rounded rest, and what is added for its rounding.
        const T error = abs(logarithm) * (LOG2_ERROR + U) + inside * (2 * U);
        const T exponent = (logarithm + error * sign) * s.shape;
        const T value = exp2(exponent + abs(exponent) * (1.01 * U * sign)) * s.opacity;
        return select(r2 < T(1.0), value * (1 + sign * (EXP2_ERROR + 2.01 * U)), T(0.0));
    }
};

}  // namespace GSB_ISA
}  // namespace gsb
