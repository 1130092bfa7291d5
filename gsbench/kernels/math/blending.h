// One projected Gaussian at one pixel (3DGS eq. 3): its alpha by either profile, and the gradients of blending.
#pragma once

#include "projection.h"

namespace gsb {
inline namespace GSB_ISA {

// The falloff of a projected Gaussian at a pixel: alpha, and the coordinates u, w in which the Gaussian is isotropic.
// The splat has p, q, r, opacity and, of a Beta profile, shape.
template <class T, class Profile = Gaussian>
struct Falloff {
    T dx, dy, u, w;
    T free;   // opacity 2^-(u^2 + w^2), before it is held below ALPHA_MAX
    T alpha;  // after

    template <class S>
    GSB_HD Falloff(T dx, T dy, const S& s) : dx(dx), dy(dy) {
        w = T(s.p) * dx;
        u = T(s.q) * dx + T(s.r) * dy;
        free = T(s.opacity) * exp2(-(w * w) - u * u);
        alpha = min(free, T(ALPHA_MAX));
    }
};

template <class T>
struct Falloff<T, Beta> {
    T dx, dy, u, w;
    T rest, log2_rest;  // 1 - r^2, held above RIM_MIN, and its logarithm
    T free, alpha;      // free: opacity (1 - r^2)^shape

    template <class S>
    GSB_HD Falloff(T dx, T dy, const S& s) : dx(dx), dy(dy) {
        const T one(1.0f);
        w = T(s.p) * dx;
        u = T(s.q) * dx + T(s.r) * dy;
        const T r2 = min((w * w + u * u) * T(1 / HALF_LOG2_E), one), difference = one - r2;
        rest = max(difference, T(RIM_MIN));
        // The second term is what rounding took from the difference: large exponents need it.
        log2_rest = log2(rest) + ((one - difference) - r2) * T(LOG2_E);
        free = select(r2 < one, T(s.opacity) * exp2(T(log2_rest * T(s.shape))), T(0.0f));
        alpha = min(free, T(ALPHA_MAX));
    }
};

// The sums over a Gaussian's pixels that its gradient needs: moments of v = alpha dLoss/dalpha.
template <class T, class Profile = Gaussian>
struct FalloffMoments {
    enum { V, U, W, W_DX, U_DX, U_DY, SHAPE };
    T of[Profile::MOMENTS];

    GSB_HD void add(const Falloff<T, Profile>& f, T g) {
        of[V] += g;
        T slope = g;
        if constexpr (Profile::HAS_SHAPE) {
            of[SHAPE] += g * f.log2_rest;
            slope = g / f.rest;
        }
        const T gu = slope * f.u, gw = slope * f.w;
        of[U] += gu;
        of[W] += gw;
        of[W_DX] += gw * f.dx;
        of[U_DX] += gu * f.dx;
        of[U_DY] += gu * f.dy;
    }
};

// Computes the gradients of x, y, p, q, r, opacity and shape from the moments. With power = u^2 + w^2 and opacity o,
// dalpha = alpha (dlog2 o - dpower) ln 2 of a Gaussian. Of a Beta profile with shape b it is
// alpha (dlog2 o - 2 b / (1 - r^2) dpower + log2(1 - r^2) db) ln 2.
template <class Profile, class S>
GSB_HD inline void splat_gradient(const FalloffMoments<float, Profile>& moments, const S& s,
                                  float (&g)[Profile::MOMENTS]) {
    using M = FalloffMoments<float, Profile>;
    const auto& m = moments.of;
    float scale = 2.0f * static_cast<float>(LN_2);
    if constexpr (Profile::HAS_SHAPE) {
        scale *= 2.0f * s.shape;
        g[6] = static_cast<float>(LN_2) * m[M::SHAPE];
    }
    g[0] = scale * (s.p * m[M::W] + s.q * m[M::U]);
    g[1] = scale * (s.r * m[M::U]);
    g[2] = -scale * m[M::W_DX];
    g[3] = -scale * m[M::U_DX];
    g[4] = -scale * m[M::U_DY];
    g[5] = m[M::V] / s.opacity;
}

// Returns the minimum of the power u^2 + w^2 in the rectangle [x0, x1] x [y0, y1], whose origin is the Gaussian's mean.
// The minimum is zero if the rectangle contains the mean. Otherwise it lies on an edge that faces the mean, at the foot
// of the perpendicular (in the Gaussian's metric) or at a corner. foot_y = -q / r and foot_x = -q r / (p^2 + q^2) give
// the positions of the minimum on a vertical and a horizontal line.
template <class T>
GSB_HD inline T least_power(T x0, T x1, T y0, T y1, T p, T q, T r, T foot_x, T foot_y) {
    const T zero(0.0f);
    const T near_x = clamp(zero, x0, x1), near_y = clamp(zero, y0, y1);
    const T along_y = clamp(T(foot_y * near_x), y0, y1), along_x = clamp(T(foot_x * near_y), x0, x1);
    const T w1 = p * near_x, u1 = q * near_x + r * along_y;
    const T w2 = p * along_x, u2 = q * along_x + r * near_y;
    return min(w1 * w1 + u1 * u1, w2 * w2 + u2 * u2);
}

}  // namespace GSB_ISA
}  // namespace gsb
