// Projects a 3D Gaussian to the image plane (EWA splatting, Zwicker et al. 2001, eq. 29), computed on square roots.
//
// The 3D covariance is F F^T. The 2D covariance is M M^T + eps2d I with the rows m1, m2 of M = J W F. Its determinant
// and its inverse are computed without subtracting large numbers:
//   det = |m1 x m2|^2 + eps2d (|m1|^2 + |m2|^2) + eps2d^2            (Lagrange's identity)
//   power = w^2 + u^2,  w = p dx,  u = q dx + r dy                    (a triangular root of the inverse)
// So the falloff of a needle-shaped Gaussian is exact up to rounding, and the power is never negative. p, q, r are
// scaled such that alpha = opacity 2^-power for a Gaussian; r^2 = power / HALF_LOG2_E for either profile. Since det has
// the unit pixels^4, it would overflow float32 for a Gaussian of 10^9 pixels. Therefore everything is computed in units
// of `size`, the size of the projected Gaussian. The result does not depend on `size`, so derivatives treat it as a
// constant.
#pragma once

#include <cstdint>

#include "profiles.h"

namespace gsb {
inline namespace GSB_ISA {

constexpr double SQRT_HALF_LOG2_E = 0.8493218002880191;  // scales the root, as HALF_LOG2_E scales the power
constexpr float BOUNDS_MARGIN = 0.01f;            // pixels, so that rounding cuts off no pixel

// A pinhole camera and the settings of the projection, in float32 or float64.
template <class Number>
struct CameraOf {
    static constexpr Number LEAST_ALPHA = Number(1) / Number(255);  // ALPHA_MIN of float32

    Number rotation[3][3], translation[3];  // world to camera
    Number fx, fy, cx, cy;                  // pixels
    Number width, height;
    Number near, far, eps2d;
    bool antialias;

    // The Jacobian is evaluated at most 15 % of the image size outside of the image (3DGS), because it diverges far
    // away.
    GSB_HD Number tangent_min(Number center, Number focal, Number size) const {
        return (-center - Number(0.15) * size) / focal;
    }
    GSB_HD Number tangent_max(Number center, Number focal, Number size) const {
        return (size - center + Number(0.15) * size) / focal;
    }
};
using Camera = CameraOf<float>;
static_assert(Camera::LEAST_ALPHA == ALPHA_MIN);

// Reads camera number c from the arguments of a kernel.
template <class Number = float, class Args>
GSB_HD inline CameraOf<Number> camera_of(const Args& a, int64_t c) {
    const float *view = a.viewmats + c * 16, *K = a.Ks + c * 9;
    CameraOf<Number> camera;
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) camera.rotation[i][j] = view[i * 4 + j];
        camera.translation[i] = view[i * 4 + 3];
    }
    camera.fx = K[0], camera.cx = K[2], camera.fy = K[4], camera.cy = K[5];
    camera.width = static_cast<Number>(a.width), camera.height = static_cast<Number>(a.height);
    camera.near = a.near, camera.far = a.far, camera.eps2d = a.eps2d, camera.antialias = a.antialias;
    return camera;
}

template <class T>
struct Splat {
    T x, y;            // the mean, pixels
    T p, q, r;         // the root of the inverse covariance
    T opacity;         // compensated, if antialiasing
    T depth;           // camera z of the mean
    T half_x, half_y;  // alpha < 1/255 outside of the mean +- these; 0: not drawn
};

template <class T>
struct GaussianGrad {
    Vec3<T> mean;
    Vec3<T> factor[3];  // by rows
    T opacity;
    Vec3<T> rotation[3], translation;  // of the camera
};

// The projection of one Gaussian by one camera: `splat` computes it, and `vjp` computes the gradients.
template <class T, class Number = float>
struct Projection {
    const CameraOf<Number>& camera;
    Vec3<T> mean;       // world
    Vec3<T> factor[3];  // F by rows
    T opacity;

    Vec3<T> R[3];
    T x, y, z, inv_z;  // camera space
    T tan_x, tan_y;    // clamped
    Vec3<T> j1, j2;    // rows of J W
    Vec3<T> m1, m2;    // rows of M = J W F, over size
    T size, unit, eps;  // pixels; 1 / size; eps2d over size^2
    T area2, xx, xy, yy, det, compensation;

    GSB_HD Projection(const CameraOf<Number>& camera, const Vec3<T>& mean, const Vec3<T> (&F)[3], T opacity)
        : camera(camera), mean(mean), factor{F[0], F[1], F[2]}, opacity(opacity) {
        for (int i = 0; i < 3; ++i) {
            R[i] = {T(camera.rotation[i][0]), T(camera.rotation[i][1]), T(camera.rotation[i][2])};
        }
    }

    // Projects a Gaussian with this profile; `shape` is the exponent of a Beta profile.
    template <class Profile>
    GSB_HD Splat<T> splat(T shape = T(0.0f)) {
        const T one(1.0f), zero(0.0f);
        x = dot(R[0], mean) + camera.translation[0];
        y = dot(R[1], mean) + camera.translation[1];
        const T depth = dot(R[2], mean) + camera.translation[2];
        const auto in_range = (depth > T(camera.near)) & (depth < T(camera.far));
        z = select(in_range, depth, one);  // what is not drawn passes through harmlessly
        inv_z = one / z;
        tan_x = clamp(T(x * inv_z), T(camera.tangent_min(camera.cx, camera.fx, camera.width)),
                      T(camera.tangent_max(camera.cx, camera.fx, camera.width)));
        tan_y = clamp(T(y * inv_z), T(camera.tangent_min(camera.cy, camera.fy, camera.height)),
                      T(camera.tangent_max(camera.cy, camera.fy, camera.height)));
        j1 = (R[0] - R[2] * tan_x) * (inv_z * camera.fx);
        j2 = (R[1] - R[2] * tan_y) * (inv_z * camera.fy);
        m1 = factor[0] * j1.x + factor[1] * j1.y + factor[2] * j1.z;
        m2 = factor[0] * j2.x + factor[1] * j2.y + factor[2] * j2.z;
        const T square = dot(m1, m1) + dot(m2, m2) + camera.eps2d;
        size = sqrt(select(square > zero, square, one));
        unit = one / size;
        eps = unit * unit * camera.eps2d;
        m1 = m1 * unit;
        m2 = m2 * unit;

        const Vec3<T> normal = cross(m1, m2);
        area2 = dot(normal, normal);
        const T traceless_xx = dot(m1, m1), traceless_yy = dot(m2, m2);
        xx = traceless_xx + eps;
        yy = traceless_yy + eps;
        xy = dot(m1, m2);
        det = area2 + (traceless_xx + traceless_yy) * eps + eps * eps;
        const auto solid = in_range & (det > zero);
        det = select(solid, det, one);
        xx = select(solid, xx, one);
        compensation = camera.antialias ? sqrt(area2 / det) : one;

        Splat<T> s;
        s.x = x * inv_z * camera.fx + camera.cx;
        s.y = y * inv_z * camera.fy + camera.cy;
        s.p = unit * T(SQRT_HALF_LOG2_E) / sqrt(xx);
        s.r = sqrt(xx / det) * (unit * T(SQRT_HALF_LOG2_E));
        s.q = zero - xy / xx * s.r;
        s.opacity = opacity * compensation;
        s.depth = depth;
        // alpha >= 1/255 only inside the ellipse r^2 <= reach; this is the bounding box of the ellipse.
        const T reach = Profile::reach(s.opacity, shape);
        s.half_x = sqrt(T(reach * xx)) * size + BOUNDS_MARGIN;
        s.half_y = sqrt(T(reach * yy)) * size + BOUNDS_MARGIN;
        const auto drawn = solid & (s.opacity >= T(camera.LEAST_ALPHA)) & (s.x + s.half_x > zero) &
                           (s.y + s.half_y > zero) & (s.x - s.half_x < T(camera.width)) &
                           (s.y - s.half_y < T(camera.height));
        s.half_x = select(drawn, s.half_x, zero);
        s.half_y = select(drawn, s.half_y, zero);
        return s;
    }

    // Returns the gradients of the inputs; call it after `splat`. g.half_* are ignored, because bounds have no
    // gradient.
    GSB_HD GaussianGrad<T> vjp(const Splat<T>& s, const Splat<T>& g) const {
        const T zero(0.0f);
        GaussianGrad<T> out;
        // p, q, r and the compensation to the covariance xx, xy and det
        T g_xx = (g.r * s.r - g.p * s.p) * 0.5f / xx;
        T g_det = zero - g.r * s.r * 0.5f / det;
        const T slope = xy / xx;  // q = -slope r
        const T g_slope = zero - g.q * s.r;
        g_xx = g_xx - (g.q * slope * s.r * 0.5f + g_slope * slope) / xx;
        g_det = g_det + g.q * slope * s.r * 0.5f / det;
        const T g_xy = g_slope / xx;
        T g_area2 = zero;
        out.opacity = g.opacity * compensation;
        if (camera.antialias) {
            const T half = g.opacity * opacity * compensation * 0.5f;
            g_area2 = select(area2 > zero, half / select(area2 > zero, area2, T(1.0f)), zero);
            g_det = g_det - half / det;
        }
        g_area2 = g_area2 + g_det;
        g_xx = g_xx + g_det * eps;
        const T g_yy = g_det * eps;
        // to m1, m2 and on to F and J W
        const Vec3<T> normal = cross(m1, m2);
        const Vec3<T> g_m1 = (m1 * (g_xx * 2.0f) + m2 * g_xy + cross(m2, normal) * (g_area2 * 2.0f)) * unit;
        const Vec3<T> g_m2 = (m2 * (g_yy * 2.0f) + m1 * g_xy + cross(normal, m1) * (g_area2 * 2.0f)) * unit;
        out.factor[0] = g_m1 * j1.x + g_m2 * j2.x;
        out.factor[1] = g_m1 * j1.y + g_m2 * j2.y;
        out.factor[2] = g_m1 * j1.z + g_m2 * j2.z;
        const Vec3<T> g_j1{dot(factor[0], g_m1), dot(factor[1], g_m1), dot(factor[2], g_m1)};
        const Vec3<T> g_j2{dot(factor[0], g_m2), dot(factor[1], g_m2), dot(factor[2], g_m2)};
        // j = focal / z (R_i - tan R_2)
        const Vec3<T> g_row1 = g_j1 * (inv_z * camera.fx), g_row2 = g_j2 * (inv_z * camera.fy);
        T g_z = zero - (dot(g_j1, j1) + dot(g_j2, j2)) * inv_z;
        const T raw_x = x * inv_z, raw_y = y * inv_z;
        const T g_tan_x = select(raw_x == tan_x, zero - dot(g_row1, R[2]), zero);
        const T g_tan_y = select(raw_y == tan_y, zero - dot(g_row2, R[2]), zero);
        const T g_x = (g.x * camera.fx + g_tan_x) * inv_z;
        const T g_y = (g.y * camera.fy + g_tan_y) * inv_z;
        g_z = g_z - g_x * raw_x - g_y * raw_y + g.depth;

        out.mean = R[0] * g_x + R[1] * g_y + R[2] * g_z;
        out.translation = {g_x, g_y, g_z};
        out.rotation[0] = mean * g_x + g_row1;
        out.rotation[1] = mean * g_y + g_row2;
        out.rotation[2] = mean * g_z - g_row1 * tan_x - g_row2 * tan_y;
        return out;
    }
};

}  // namespace GSB_ISA
}  // namespace gsb
