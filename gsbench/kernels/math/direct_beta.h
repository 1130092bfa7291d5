// One Gaussian of dBS, a Beta profile that moves and fades with direction and, if K = 4, time: its 3D Gaussian for a
// view, and the gradients.
#pragma once

#include "beta_slice.h"
#include "coupled.h"
#include "direct.h"

namespace gsb {
inline namespace GSB_ISA {

template <class T>
struct StaticBetaParameters {
    T scales[3], skew[3], opacity, beta;  // sizes are softplus of scales; A_01, A_02, A_12; a logit; of the profile

    // Calls f(array, parameter) for all but the opacity, with the arrays of the parameters or of their gradients.
    template <class Arrays, class F>
    GSB_HD void each(const Arrays& a, F f) {
        f(a.scales, scales);
        f(a.skew, skew);
        f(a.betas, a.times ? 5 : 4, 0, beta);  // the first column
    }
};

// A Gaussian of dBS that does not depend on time or direction: its factor (I + A) S, its opacity and its exponent.
template <class T>
struct StaticBetaGaussian {
    const StaticBetaParameters<T>& raw;
    SkewTurn<T> skew;
    T factor[3][3], size[3], opacity, shape;

    GSB_HD explicit StaticBetaGaussian(const StaticBetaParameters<T>& raw) : raw(raw), skew(raw.skew) {
        GSB_UNROLL for (int j = 0; j < 3; ++j) {
            size[j] = bounded_softplus(raw.scales[j]);
            GSB_UNROLL for (int i = 0; i < 3; ++i) factor[i][j] = skew.turn[i][j] * size[j];
        }
        opacity = sigmoid(raw.opacity);
        shape = size_of(raw.beta) * 4.0f;
    }

    GSB_HD void vjp(const T (&g_factor)[3][3], T g_opacity, T g_shape, StaticBetaParameters<T>& out) const {
        T g_size[3];
        skew.vjp(g_factor, size, out.skew, g_size);
        GSB_UNROLL for (int k = 0; k < 3; ++k) out.scales[k] = bounded_softplus_vjp(raw.scales[k], size[k], g_size[k]);
        out.opacity = g_opacity * opacity * (T(1.0f) - opacity);
        out.beta = size_vjp(raw.beta, shape, g_shape);
    }
};

template <class T>
GSB_HD inline void still_vjp(const StaticBetaGaussian<T>& still, const ObservedBeta<T>& g, StaticBetaParameters<T>& out) {
    still.vjp(g.factor, g.opacity, g.shape, out);
}

template <class T, int K>
struct DirectBetaParameters {
    StaticBetaParameters<T> still;
    CoupledParameters<T, K> motion;
    T mean[3], direction[3], time, betas[K];  // the last are of the opacity factors

    // Calls f(array, parameter) for all but the opacity, with the arrays of the parameters or of their gradients.
    template <class Arrays, class F>
    GSB_HD void each(const Arrays& a, F f) {
        still.each(a, f);
        f(a.means, mean);
        f(a.directions, direction);
        if constexpr (K > 3) f(a.times, time);
        f(a.precision, motion.precision);
        f(a.coupling, motion.coupling);
        f(a.betas, 1 + K, 1, betas);
    }
};

template <class T, int K>
struct DirectBetaGaussian {
    using Parameters = DirectBetaParameters<T, K>;
    using Still = StaticBetaGaussian<T>;
    using StillParameters = StaticBetaParameters<T>;
    using Seen = ObservedBeta<T>;

    const Parameters& raw;
    Still still;
    BetaExponents<T, K> beta;
    CoupledMotion<T, K> motion;
    BetaFading<T, K> fading;

    GSB_HD DirectBetaGaussian(const Parameters& raw, const ViewPoint& view)
        : raw(raw), still(raw.still), beta(raw.betas), motion(moved(view)), fading(motion.white, beta.exponents) {}

    GSB_HD Seen observe() const {
        Seen out;
        GSB_UNROLL for (int i = 0; i < 3; ++i) {
            out.mean[i] = raw.mean[i] + motion.mean_size * motion.shift[i];
            GSB_UNROLL for (int j = 0; j < 3; ++j) out.factor[i][j] = still.factor[i][j];
        }
        out.opacity = still.opacity * fading.factor;
        out.shape = still.shape;
        return out;
    }

    GSB_HD void vjp(const Seen& g, Parameters& out) const {
        const T zero(0.0f), third(1.0f / 3.0f);
        T g_white[K], g_exponents[K], g_weights[K], g_delta[K];
        fading.vjp(motion.white, beta.exponents, g.opacity * still.opacity, g_white, g_exponents);
        const T g_size = motion.vjp(g.mean, g_white, out.motion, g_weights, g_delta) * third;
        beta.vjp(raw.betas, g_exponents, g_weights, out.betas);
        GSB_UNROLL for (int i = 0; i < 3; ++i) out.direction[i] = zero - g_delta[i];
        if constexpr (K > 3) out.time = zero - g_delta[3];
        still.vjp(g.factor, g.opacity * fading.factor, g.shape, out.still);
        GSB_UNROLL for (int i = 0; i < 3; ++i) {
            out.mean[i] = g.mean[i];
            const T g_scale = bounded_softplus_vjp(raw.still.scales[i], still.size[i], g_size);
            out.still.scales[i] = out.still.scales[i] + g_scale;
        }
    }

private:
    GSB_HD CoupledMotion<T, K> moved(const ViewPoint& view) const {
        const Vec3<T> d = direction_to(raw.mean, view);
        T delta[K];
        delta[0] = d.x - raw.direction[0];
        delta[1] = d.y - raw.direction[1];
        delta[2] = d.z - raw.direction[2];
        if constexpr (K > 3) delta[3] = T(view.time) - raw.time;
        return {raw.motion, delta, beta.weights, (still.size[0] + still.size[1] + still.size[2]) * (1.0f / 3.0f)};
    }
};

}  // namespace GSB_ISA
}  // namespace gsb
