// One Gaussian of SharpTimeGS, a FreeTimeGS whose opacity is constant around its mean time: its 3D Gaussian at a time,
// and the gradients.
#pragma once

#include "free_time.h"

namespace gsb {
inline namespace GSB_ISA {

template <class T>
struct SharpTimeParameters : FreeTimeParameters<T> {
    T plateau;  // a logarithm

    // Calls f(array, parameter) for all but the opacity, with the arrays of the parameters or of their gradients.
    template <class Arrays, class F>
    GSB_HD void each(const Arrays& a, F f) {
        FreeTimeParameters<T>::each(a, f);
        f(a.plateaus, plateau);
    }
};

template <class T>
struct SharpTimeGaussian {
    using Parameters = SharpTimeParameters<T>;
    using Still = StaticGaussian<T>;
    using StillParameters = StaticParameters<T>;
    using Seen = Observed<T>;

    const Parameters& raw;
    Still still;
    T delta, sigma, r, life, white, opacity_factor, slowness;  // slowness: 1 / f

    GSB_HD SharpTimeGaussian(const Parameters& raw, const ViewPoint& view) : raw(raw), still(raw.still) {
        delta = T(view.time) - raw.time;
        sigma = size_of(raw.duration);
        r = size_of(raw.plateau);
        life = sigma + r;
        white = (delta - clamp(delta, T(0.0f) - r, r)) / sigma;
        opacity_factor = exp(T(white * white * -1.0f));
        slowness = T(1.0f) / (T(1.0f) + max(T(1.0f), T(life * life)));
    }

    GSB_HD Seen observe() const {
        Seen out;
        GSB_UNROLL for (int i = 0; i < 3; ++i) {
            out.mean[i] = raw.mean[i] + raw.velocity[i] * T(delta * slowness);
            GSB_UNROLL for (int j = 0; j < 3; ++j) out.factor[i][j] = still.factor[i][j];
        }
        out.opacity = still.opacity * opacity_factor;
        return out;
    }

    GSB_HD void vjp(const Seen& g, Parameters& out) const {
        T g_shift = T(0.0f);  // by the time for which the mean has moved at the velocity, delta / f
        GSB_UNROLL for (int i = 0; i < 3; ++i) {
            out.mean[i] = g.mean[i];
            out.velocity[i] = g.mean[i] * T(delta * slowness);
            g_shift = g_shift + g.mean[i] * raw.velocity[i];
        }
        const T g_exponent = g.opacity * still.opacity * opacity_factor;  // of -white^2
        const T g_white = g_exponent * white * -2.0f;
        const T g_life = select(life < T(1.0f), T(0.0f), T(g_shift * delta * slowness * slowness * life * -2.0f));
        const T g_r = g_exponent * max(white, T(0.0f) - white) * 2.0f / sigma;
        out.time = T(0.0f) - g_white / sigma - g_shift * slowness;
        out.duration = size_vjp(raw.duration, sigma, T(g_life - g_white * white / sigma));
        out.plateau = size_vjp(raw.plateau, r, T(g_life + g_r));
        still.vjp(g.factor, g.opacity * opacity_factor, out.still);
    }
};

}  // namespace GSB_ISA
}  // namespace gsb
