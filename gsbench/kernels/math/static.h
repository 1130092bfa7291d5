// One 3DGS Gaussian, which does not depend on time or direction: its factor R S (eq. 6), its opacity, and the
// gradients.
#pragma once

#include "parameters.h"

namespace gsb {
inline namespace GSB_ISA {

template <class T>
struct StaticParameters {
    T scales[3], quat[4], opacity;  // logs; wxyz of any length; a logit

    // Calls f(array, parameter) for all but the opacity, with the arrays of the parameters or of their gradients.
    template <class Arrays, class F>
    GSB_HD void each(const Arrays& a, F f) {
        f(a.scales, scales);
        f(a.quats, quat);
    }
};

template <class T>
struct StaticGaussian {
    const StaticParameters<T>& raw;
    UnitQuaternion<T> unit;
    T factor[3][3], size[3], opacity;

    GSB_HD explicit StaticGaussian(const StaticParameters<T>& raw) : raw(raw), unit(raw.quat) {
        const T w = unit.q[0], x = unit.q[1], y = unit.q[2], z = unit.q[3], one(1.0f), two(2.0f);
        const T R[3][3] = {{one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)},
                           {two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)},
                           {two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)}};
        GSB_UNROLL for (int j = 0; j < 3; ++j) {
            size[j] = size_of(raw.scales[j]);
            GSB_UNROLL for (int i = 0; i < 3; ++i) factor[i][j] = R[i][j] * size[j];
        }
        opacity = sigmoid(raw.opacity);
    }

    GSB_HD void vjp(const T (&g_factor)[3][3], T g_opacity, StaticParameters<T>& out) const {
        T g[3][3];  // of R
        GSB_UNROLL for (int j = 0; j < 3; ++j) {
            T along(0.0f);  // the gradient of log size is that of the factor's column along the column itself
            GSB_UNROLL for (int i = 0; i < 3; ++i) {
                along = along + g_factor[i][j] * factor[i][j];
                g[i][j] = g_factor[i][j] * size[j];
            }
            out.scales[j] = size_vjp(raw.scales[j], T(1.0f), along);
        }
        const T w = unit.q[0], x = unit.q[1], y = unit.q[2], z = unit.q[3], two(2.0f);
        // The entries of R are sums and differences of products of two quaternion entries.
        const T xy = g[0][1] + g[1][0], xz = g[0][2] + g[2][0], yz = g[1][2] + g[2][1];
        const T wx = g[2][1] - g[1][2], wy = g[0][2] - g[2][0], wz = g[1][0] - g[0][1];
        const T g_q[4] = {two * (x * wx + y * wy + z * wz),
                          two * (y * xy + z * xz + w * wx - two * x * (g[1][1] + g[2][2])),
                          two * (x * xy + z * yz + w * wy - two * y * (g[0][0] + g[2][2])),
                          two * (x * xz + y * yz + w * wz - two * z * (g[0][0] + g[1][1]))};
        unit.vjp(g_q, out.quat);
        out.opacity = g_opacity * opacity * (T(1.0f) - opacity);
    }
};

}  // namespace GSB_ISA
}  // namespace gsb
