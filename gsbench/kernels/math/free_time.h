// One Gaussian of FreeTimeGS, which has a velocity and fades around its mean time: its 3D Gaussian at a time, and the
// gradients.
#pragma once

#include "direct.h"

namespace gsb {
inline namespace GSB_ISA {

template <class T>
struct FreeTimeParameters {
    StaticParameters<T> still;
    T mean[3], time, duration, velocity[3];  // duration: a logarithm

    // Calls f(array, parameter) for all but the opacity, with the arrays of the parameters or of their gradients.
    template <class Arrays, class F>
    GSB_HD void each(const Arrays& a, F f) {
        still.each(a, f);
        f(a.means, mean);
        f(a.times, time);
        f(a.durations, duration);
        f(a.velocities, velocity);
    }
};

template <class T>
struct FreeTimeGaussian {
    using Parameters = FreeTimeParameters<T>;
    using Still = StaticGaussian<T>;
    using StillParameters = StaticParameters<T>;
    using Seen = Observed<T>;

    const Parameters& raw;
    Still still;
    T delta, duration, white, opacity_factor;

    GSB_HD FreeTimeGaussian(const Parameters& raw, const ViewPoint& view) : raw(raw), still(raw.still) {
        delta = T(view.time) - raw.time;
        duration = size_of(raw.duration);
        white = delta / duration;
        opacity_factor = exp(T(white * white * -0.5f));
    }

    GSB_HD Seen observe() const {
        Seen out;
        GSB_UNROLL for (int i = 0; i < 3; ++i) {
            out.mean[i] = raw.mean[i] + raw.velocity[i] * delta;
            GSB_UNROLL for (int j = 0; j < 3; ++j) out.factor[i][j] = still.factor[i][j];
        }
        out.opacity = still.opacity * opacity_factor;
        return out;
    }

    GSB_HD void vjp(const Seen& g, Parameters& out) const {
        const T g_exponent = g.opacity * still.opacity * opacity_factor;  // of -white^2 / 2
        out.time = g_exponent * white / duration;
        out.duration = size_vjp(raw.duration, T(1.0f), T(g_exponent * white * white));
        GSB_UNROLL for (int i = 0; i < 3; ++i) {
            out.mean[i] = g.mean[i];
            out.velocity[i] = g.mean[i] * delta;
            out.time = out.time - g.mean[i] * raw.velocity[i];
        }
        still.vjp(g.factor, g.opacity * opacity_factor, out.still);
    }
};

}  // namespace GSB_ISA
}  // namespace gsb
