// One projected Gaussian at one pixel (3DGS eq. 3): its alpha, and the gradients of blending.
#pragma once

#include "projection.h"

namespace gsb {
inline namespace GSB_ISA {

// The falloff of a projected Gaussian at a pixel: alpha, and the coordinates u, w in which the Gaussian is isotropic.
template <class T>
struct Falloff {
    T dx, dy, u, w;
    T free;   // opacity 2^-(u^2 + w^2), before it is held below ALPHA_MAX
    T alpha;  // after

    GSB_HD Falloff(T dx, T dy, T p, T q, T r, T opacity) : dx(dx), dy(dy) {
        w = p * dx;
        u = q * dx + r * dy;
        free = opacity * exp2(-(w * w) - u * u);
        alpha = min(free, T(ALPHA_MAX));
    }
};

// The sums over a Gaussian's pixels that its gradient needs: moments of v = alpha dLoss/dalpha.
template <class T>
struct FalloffMoments {
    T v, u, w, w_dx, u_dx, u_dy;

    GSB_HD void add(const Falloff<T>& f, T g) {
        const T gu = g * f.u, gw = g * f.w;
        v += g;
        u += gu;
        w += gw;
        w_dx += gw * f.dx;
        u_dx += gu * f.dx;
        u_dy += gu * f.dy;
    }
};

// Computes the gradients of x, y, p, q, r, opacity from the moments, by dalpha = alpha (dlog2 o - dpower) ln 2 with
// power = u^2 + w^2 and opacity o.
GSB_HD inline void splat_gradient(const FalloffMoments<float>& m, float p, float q, float r, float opacity,
                                  float (&g)[6]) {
    constexpr float two_ln2 = 2.0f * LN_2;
    g[0] = two_ln2 * (p * m.w + q * m.u);
    g[1] = two_ln2 * (r * m.u);
    g[2] = -two_ln2 * m.w_dx;
    g[3] = -two_ln2 * m.u_dx;
    g[4] = -two_ln2 * m.u_dy;
    g[5] = m.v / opacity;
}

// Returns the minimum of the power u^2 + w^2 in the rectangle [x0, x1] x [y0, y1], whose origin is the Gaussian's mean.
// The minimum is zero if the rectangle contains the mean. Otherwise it lies on an edge that faces the mean, at the foot
// of the perpendicular (in the Gaussian's metric) or at a corner. foot_y = -q / r and foot_x = -q r / (p^2 + q^2) give
// the positions of the minimum on a vertical and a horizontal line.
template <class T>
GSB_HD inline T least_power(T x0, T x1, T y0, T y1, T p, T q, T r, T foot_x, T foot_y) {
    const T zero(0.0f);
    const T near_x = clamp(zero, x0, x1), near_y = clamp(zero, y0, y1);
    const T along_y = clamp(foot_y * near_x, y0, y1), along_x = clamp(foot_x * near_y, x0, x1);
    const T w1 = p * near_x, u1 = q * near_x + r * along_y;
    const T w2 = p * along_x, u2 = q * along_x + r * near_y;
    return min(w1 * w1 + u1 * u1, w2 * w2 + u2 * u2);
}

}  // namespace GSB_ISA
}  // namespace gsb
