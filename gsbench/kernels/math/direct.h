// One Gaussian of dGS, which moves and fades with direction and time: its 3D Gaussian for a view, and the gradients.
#pragma once

#include "coupled.h"
#include "static.h"
#include "triangular.h"

namespace gsb {
inline namespace GSB_ISA {

// The direction from the camera to a mean, through which no gradient flows.
template <class T>
GSB_HD inline Vec3<T> direction_to(const T (&mean)[3], const ViewPoint& view) {
    return Unit<T>({mean[0] - view.center[0], mean[1] - view.center[1], mean[2] - view.center[2]}).direction;
}

template <class T>
struct DirectParameters {
    StaticParameters<T> still;
    CoupledParameters<T, 4> motion;
    T mean[3], direction[3], time, shares[2];  // direction of any length; the last two are logits

    // Calls f(array, parameter) for all but the opacity, with the arrays of the parameters or of their gradients.
    template <class Arrays, class F>
    GSB_HD void each(const Arrays& a, F f) {
        still.each(a, f);
        f(a.means, mean);
        f(a.directions, direction);
        f(a.times, time);
        f(a.precision, motion.precision);
        f(a.coupling, motion.coupling);
        f(a.shares, shares);
    }
};

// The gradients of a static Gaussian, from those of what is seen of it.
template <class T>
GSB_HD inline void still_vjp(const StaticGaussian<T>& still, const Observed<T>& g, StaticParameters<T>& out) {
    still.vjp(g.factor, g.opacity, out);
}

template <class T>
struct DirectGaussian {
    using Parameters = DirectParameters<T>;
    using Still = StaticGaussian<T>;
    using StillParameters = StaticParameters<T>;
    using Seen = Observed<T>;

    const Parameters& raw;
    Still still;
    Unit<T> direction;
    T time, shares[2], opacity_factor;
    CoupledMotion<T, 4> motion;

    GSB_HD DirectGaussian(const Parameters& raw, const ViewPoint& view)
        : raw(raw), still(raw.still), direction({raw.direction[0], raw.direction[1], raw.direction[2]}),
          time(sigmoid(raw.time)), shares{sigmoid(raw.shares[0]), sigmoid(raw.shares[1])}, motion(moved(view)) {
        T squares(0.0f);
        GSB_UNROLL for (int k = 0; k < 4; ++k) squares = squares + motion.white[k] * motion.white[k];
        opacity_factor = exp(T(squares * -DIRECT_FADING));
    }

    GSB_HD Seen observe() const {
        Seen out;
        GSB_UNROLL for (int i = 0; i < 3; ++i) {
            out.mean[i] = raw.mean[i] + motion.mean_size * motion.shift[i];
            GSB_UNROLL for (int j = 0; j < 3; ++j) out.factor[i][j] = still.factor[i][j];
        }
        out.opacity = still.opacity * opacity_factor;
        return out;
    }

    GSB_HD void vjp(const Seen& g, Parameters& out) const {
        const T zero(0.0f), third(1.0f / 3.0f);
        const T g_squares = g.opacity * still.opacity * opacity_factor * -DIRECT_FADING;
        T g_white[4], g_weights[4], g_delta[4];
        GSB_UNROLL for (int k = 0; k < 4; ++k) g_white[k] = g_squares * motion.white[k] * 2.0f;
        const T g_size = motion.vjp(g.mean, g_white, out.motion, g_weights, g_delta) * third;
        const T g_shares[2] = {g_weights[0] + g_weights[1] + g_weights[2], g_weights[3]};
        GSB_UNROLL for (int k = 0; k < 2; ++k) out.shares[k] = g_shares[k] * shares[k] * (T(1.0f) - shares[k]);
        out.time = zero - g_delta[3] * time * (T(1.0f) - time);
        const Vec3<T> g_direction = direction.vjp({zero - g_delta[0], zero - g_delta[1], zero - g_delta[2]});
        out.direction[0] = g_direction.x;
        out.direction[1] = g_direction.y;
        out.direction[2] = g_direction.z;
        still.vjp(g.factor, g.opacity * opacity_factor, out.still);
        GSB_UNROLL for (int i = 0; i < 3; ++i) {
            out.mean[i] = g.mean[i];
            out.still.scales[i] = out.still.scales[i] + size_vjp(raw.still.scales[i], still.size[i], g_size);
        }
    }

private:
    GSB_HD CoupledMotion<T, 4> moved(const ViewPoint& view) const {
        const Vec3<T> offset = direction_to(raw.mean, view) - direction.direction;
        const T delta[4] = {offset.x, offset.y, offset.z, T(view.time) - time};
        const T weights[4] = {shares[0], shares[0], shares[0], shares[1]};
        return {raw.motion, delta, weights, (still.size[0] + still.size[1] + still.size[2]) * (1.0f / 3.0f)};
    }
};

}  // namespace GSB_ISA
}  // namespace gsb
