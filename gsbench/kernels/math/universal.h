// One Gaussian of Universal Beta Splatting over position p, direction and, if TIME, time: its conditional 3D Gaussian
// with the exponent of its Beta profile, and the gradients. The formulas are those of gsbench/models/beta.py.
#pragma once

#include "beta_slice.h"
#include "harmonics.h"
#include "parameters.h"
#include "slicing.h"

namespace gsb {
inline namespace GSB_ISA {

// A row of a factor that a reflection from the right changes into the row (length, 0, .., 0). Only E + 1 of its entries
// are not zero: `first`, and the vector `rest`. The reflection changes the same entries of every other row.
template <class T, int E>
struct Reflection {
    T first, rest[E];
    T length, inverse, step;  // length has the sign of `first`; 1 / length; 1 / (first + length)

    Reflection() = default;
    GSB_HD Reflection(T first, const T (&row)[E]) : first(first) {
        const T zero(0.0f), one(1.0f);
        T square = first * first;
        GSB_UNROLL for (int j = 0; j < E; ++j) {
            rest[j] = row[j];
            square = square + row[j] * row[j];
        }
        const auto there = square > zero;  // a row of zeros does not change
        const T size = sqrt(select(there, square, one));
        const T signed_size = select(first < zero, zero - size, size);
        length = select(there, signed_size, zero);
        inverse = select(there, one / signed_size, zero);
        step = select(there, one / (first + signed_size), zero);
    }

    // Changes another row with the entries x and `row`; returns its new first entry.
    GSB_HD T apply(T x, T (&row)[E]) const {
        T along = x * first;
        GSB_UNROLL for (int j = 0; j < E; ++j) along = along + row[j] * rest[j];
        const T out = along * inverse, by = (out + x) * step;
        GSB_UNROLL for (int j = 0; j < E; ++j) row[j] = row[j] - by * rest[j];
        return out;
    }
};

// The gradients of a reflection's row, summed over the rows that it changes, and then over its own length.
template <class T, int E>
struct ReflectionGrads {
    const Reflection<T, E>& at;
    T first, rest[E], inverse, step;

    GSB_HD explicit ReflectionGrads(const Reflection<T, E>& at) : at(at) {
        first = inverse = step = T(0.0f);
        GSB_UNROLL for (int j = 0; j < E; ++j) rest[j] = T(0.0f);
    }

    // The derivative of `apply`, which returned `out` for x. Replaces the changed `row` by the one before, and the
    // gradient `g` of the changed row by that of the one before; returns the gradient of x.
    GSB_HD T apply_vjp(T x, T out, T (&row)[E], T g_out, T (&g)[E]) {
        const T by = (out + x) * at.step;
        T g_by(0.0f);
        GSB_UNROLL for (int j = 0; j < E; ++j) {
            row[j] = row[j] + by * at.rest[j];
            g_by = g_by - g[j] * at.rest[j];
            rest[j] = rest[j] - by * g[j];
        }
        step = step + g_by * (out + x);
        g_by = g_by * at.step;
        g_out = g_out + g_by;
        inverse = inverse + g_out * (out * at.length);
        const T g_along = g_out * at.inverse;
        first = first + g_along * x;
        GSB_UNROLL for (int j = 0; j < E; ++j) {
            rest[j] = rest[j] + g_along * row[j];
            g[j] = g[j] + g_along * at.rest[j];
        }
        return g_by + g_along * at.first;
    }

    // Adds what comes through the length, whose own gradient is given; call it after the rows.
    GSB_HD void finish(T g_length) {
        const T g_sum = T(0.0f) - step * at.step * at.step;
        g_length = (g_length + g_sum - inverse * at.inverse * at.inverse) * at.inverse;
        first = first + g_sum + g_length * at.first;
        GSB_UNROLL for (int j = 0; j < E; ++j) rest[j] = rest[j] + g_length * at.rest[j];
    }
};

// A lower triangular factor [3, 3] of R R^T, for rows R [3, W].
template <class T, int W>
struct TriangularRows {
    Reflection<T, W - 1> one;
    Reflection<T, W - 2> two;
    Reflection<T, W - 3> three;
    T second, third[2];  // first entries of rows 1 and 2 when `one` and `two` changed them
    T factor[3][3];

    GSB_HD explicit TriangularRows(const T (&R)[3][W]) {
        T a[W - 1], b[W - 1], c[W - 1];
        GSB_UNROLL for (int j = 1; j < W; ++j) {
            a[j - 1] = R[0][j];
            b[j - 1] = R[1][j];
            c[j - 1] = R[2][j];
        }
        one = Reflection<T, W - 1>(R[0][0], a);
        second = R[1][0];
        third[0] = R[2][0];
        factor[1][0] = one.apply(second, b);
        factor[2][0] = one.apply(third[0], c);
        T d[W - 2], e[W - 2];
        tail(b, d);
        tail(c, e);
        two = Reflection<T, W - 2>(b[0], d);
        third[1] = c[0];
        factor[2][1] = two.apply(third[1], e);
        T f[W - 3];
        tail(e, f);
        three = Reflection<T, W - 3>(e[0], f);
        factor[0][0] = one.length;
        factor[1][1] = two.length;
        factor[2][2] = three.length;
        factor[0][1] = factor[0][2] = factor[1][2] = T(0.0f);
    }

    // Computes the gradient of R.
    GSB_HD void vjp(const T (&g)[3][3], T (&g_R)[3][W]) const {
        ReflectionGrads<T, W - 3> g_three(three);
        g_three.finish(g[2][2]);
        T e[W - 2], g_e[W - 2];
        joined(three.first, three.rest, e);
        joined(g_three.first, g_three.rest, g_e);
        // `three` was made of the row that `two` had changed.
        ReflectionGrads<T, W - 2> g_two(two);
        const T g_third = g_two.apply_vjp(third[1], factor[2][1], e, g[2][1], g_e);
        g_two.finish(g[1][1]);
        T b[W - 1], c[W - 1], g_b[W - 1], g_c[W - 1];
        joined(two.first, two.rest, b);
        joined(third[1], e, c);
        joined(g_two.first, g_two.rest, g_b);
        joined(g_third, g_e, g_c);
        ReflectionGrads<T, W - 1> g_one(one);
        g_R[1][0] = g_one.apply_vjp(second, factor[1][0], b, g[1][0], g_b);
        g_R[2][0] = g_one.apply_vjp(third[0], factor[2][0], c, g[2][0], g_c);
        g_one.finish(g[0][0]);
        g_R[0][0] = g_one.first;
        GSB_UNROLL for (int j = 1; j < W; ++j) {
            g_R[0][j] = g_one.rest[j - 1];
            g_R[1][j] = g_b[j - 1];
            g_R[2][j] = g_c[j - 1];
        }
    }

private:
    template <int E>
    GSB_HD static void tail(const T (&row)[E], T (&out)[E - 1]) {
        GSB_UNROLL for (int j = 1; j < E; ++j) out[j - 1] = row[j];
    }
    template <int E>
    GSB_HD static void joined(T first, const T (&rest)[E], T (&out)[E + 1]) {
        out[0] = first;
        GSB_UNROLL for (int j = 0; j < E; ++j) out[j + 1] = rest[j];
    }
};

template <class T, bool TIME>
struct UniversalParameters {
    static constexpr int K = 3 + TIME, LOWER = 3 * K + K * (K - 1) / 2;
    T mean[3], direction[3], time;
    T scales[3 + K], skew[3], lower[LOWER], betas[1 + K];
    T opacity;  // a logit

    // Calls f(array, parameter) for all but the opacity, with the arrays of the parameters or of their gradients.
    template <class Arrays, class F>
    GSB_HD void each(const Arrays& a, F f) {
        f(a.means, mean);
        f(a.directions, direction);
        if constexpr (TIME) f(a.times, time);
        f(a.scales, scales);
        f(a.skew, skew);
        f(a.lower, lower);
        f(a.betas, betas);
    }
};

template <class T, bool TIME>
struct UniversalGaussian {
    using Parameters = UniversalParameters<T, TIME>;
    static constexpr int K = Parameters::K;

    const ViewPoint& view;
    const Parameters& raw;
    T size[3 + K];
    Reflection<T, 3> reflections[K];
    Reduced<T, K> t;
    Vec3<T> offset;  // camera to mean
    BetaExponents<T, K> beta;
    T white[K], root[K];  // y, (I - B)^(1/2)
    BetaFading<T, K> fading;
    T opacity, rows[3][3 + K];

    GSB_HD UniversalGaussian(const ViewPoint& view, const Parameters& raw) : view(view), raw(raw) {}

    GSB_HD ObservedBeta<T> observe() {
        const T zero(0.0f), one(1.0f);
        reduce();
        offset = {raw.mean[0] - view.center[0], raw.mean[1] - view.center[1], raw.mean[2] - view.center[2]};
        const Vec3<T> d = Unit<T>(offset).direction;
        T delta[K];
        delta[0] = d.x - raw.direction[0];
        delta[1] = d.y - raw.direction[1];
        delta[2] = d.z - raw.direction[2];
        if constexpr (TIME) delta[3] = T(view.time) - raw.time;
        whiten(t, delta, white);
        beta = BetaExponents<T, K>(raw.betas + 1);
        T shift[K];
        GSB_UNROLL for (int i = 0; i < K; ++i) {
            const T left = one - beta.weights[i];
            root[i] = select(left > zero, sqrt(select(left > zero, left, one)), zero);
            shift[i] = beta.weights[i] * white[i];
        }
        fading = BetaFading<T, K>(white, beta.exponents);
        opacity = sigmoid(raw.opacity);

        ObservedBeta<T> out;
        move_mean(t, raw.mean, shift, out.mean);
        GSB_UNROLL for (int i = 0; i < 3; ++i) {
            GSB_UNROLL for (int j = 0; j < 3; ++j) rows[i][j] = t.pp[i][j];
            GSB_UNROLL for (int j = 0; j < K; ++j) rows[i][3 + j] = t.pq[i][j] * root[j];
        }
        const TriangularRows<T, 3 + K> triangle(rows);
        GSB_UNROLL for (int i = 0; i < 3; ++i) {
            GSB_UNROLL for (int j = 0; j < 3; ++j) out.factor[i][j] = triangle.factor[i][j];
        }
        out.opacity = opacity * fading.factor;
        out.shape = size_of(raw.betas[0]) * 4.0f;
        return out;
    }

    // Computes the gradients of the parameters; call it after `observe`.
    GSB_HD void vjp(const ObservedBeta<T>& g, Parameters& out) const {
        const T zero(0.0f), one(1.0f);
        T g_rows[3][3 + K];
        TriangularRows<T, 3 + K>(rows).vjp(g.factor, g_rows);
        Reduced<T, K> g_t;
        g_t.zero();
        T shift[K], g_white[K];
        GSB_UNROLL for (int i = 0; i < K; ++i) {
            shift[i] = beta.weights[i] * white[i];
            g_white[i] = zero;  // at first the gradient of the shift
        }
        move_mean_vjp(t, shift, g.mean, g_white, g_t);
        out.opacity = g.opacity * fading.factor * opacity * (one - opacity);
        const T shape = size_of(raw.betas[0]) * 4.0f;
        out.betas[0] = size_vjp(raw.betas[0], shape, g.shape);
        GSB_UNROLL for (int i = 0; i < 3; ++i) {
            GSB_UNROLL for (int j = 0; j < 3; ++j) g_t.pp[i][j] = g_rows[i][j];
            GSB_UNROLL for (int j = 0; j < K; ++j) g_t.pq[i][j] = g_t.pq[i][j] + g_rows[i][3 + j] * root[j];
        }
        T g_faded[K], g_exponents[K], g_weights[K];
        fading.vjp(white, beta.exponents, g.opacity * opacity, g_faded, g_exponents);
        GSB_UNROLL for (int i = 0; i < K; ++i) {
            T g_root = zero;
            GSB_UNROLL for (int j = 0; j < 3; ++j) g_root = g_root + g_rows[j][3 + i] * t.pq[j][i];
            // The derivative of the root is infinite at zero; there it counts as zero.
            const auto some = root[i] > zero;
            g_weights[i] = g_white[i] * white[i] - select(some, g_root * 0.5f / select(some, root[i], one), zero);
            g_white[i] = g_white[i] * beta.weights[i] + g_faded[i];
        }
        beta.vjp(raw.betas + 1, g_exponents, g_weights, out.betas + 1);
        whiten_vjp(t, white, g_white, g_t);  // now that of delta
        const Vec3<T> g_offset = Unit<T>(offset).vjp({g_white[0], g_white[1], g_white[2]});
        out.mean[0] = g.mean[0] + g_offset.x;
        out.mean[1] = g.mean[1] + g_offset.y;
        out.mean[2] = g.mean[2] + g_offset.z;
        GSB_UNROLL for (int i = 0; i < 3; ++i) out.direction[i] = zero - g_white[i];
        out.time = zero;
        if constexpr (TIME) out.time = zero - g_white[3];
        reduce_vjp(g_t, out);
    }

private:
    // Returns the place in `lower` of the first entry of row i of q: three of L_qp, and then i of L_q.
    GSB_HD static constexpr int place(int i) { return 3 * i + i * (i - 1) / 2; }

    // Computes the factor and reduces it. With the columns of q before those of p, its rows are [L_q L_qp] and
    // [0 (I + A) S_p]. Since L_q is triangular, the reflection of row i only changes column i and those of p.
    GSB_HD void reduce() {
        GSB_UNROLL for (int i = 0; i < 3 + K; ++i) size[i] = bounded_softplus(raw.scales[i]);
        t.zero();
        const SkewTurn<T> skew(raw.skew);
        GSB_UNROLL for (int i = 0; i < 3; ++i) {
            GSB_UNROLL for (int j = 0; j < 3; ++j) t.pp[i][j] = skew.turn[i][j] * size[j];
        }
        GSB_UNROLL for (int i = 0; i < K; ++i) {
            T rest[3];
            GSB_UNROLL for (int j = 0; j < 3; ++j) rest[j] = raw.lower[place(i) + j];
            GSB_UNROLL for (int k = 0; k < i; ++k) t.qq[i][k] = reflections[k].apply(raw.lower[place(i) + 3 + k], rest);
            reflections[i] = Reflection<T, 3>(size[3 + i], rest);
            t.qq[i][i] = reflections[i].length;
        }
        GSB_UNROLL for (int i = 0; i < 3; ++i) {
            GSB_UNROLL for (int k = 0; k < K; ++k) t.pq[i][k] = reflections[k].apply(T(0.0f), t.pp[i]);
        }
    }

    GSB_HD void reduce_vjp(const Reduced<T, K>& g_t, Parameters& out) const {
        const T zero(0.0f);
        T pp[3][3], g_pp[3][3], rest[K][3], g_rest[K][3];
        GSB_UNROLL for (int j = 0; j < 3; ++j) {
            GSB_UNROLL for (int i = 0; i < 3; ++i) {
                pp[i][j] = t.pp[i][j];
                g_pp[i][j] = g_t.pp[i][j];
            }
            GSB_UNROLL for (int i = 0; i < K; ++i) {
                rest[i][j] = reflections[i].rest[j];
                g_rest[i][j] = zero;
            }
        }
        GSB_UNROLL for (int k = K - 1; k >= 0; --k) {
            ReflectionGrads<T, 3> g(reflections[k]);
            GSB_UNROLL for (int i = 0; i < 3; ++i) g.apply_vjp(zero, t.pq[i][k], pp[i], g_t.pq[i][k], g_pp[i]);
            GSB_UNROLL for (int i = k + 1; i < K; ++i) {
                out.lower[place(i) + 3 + k] =
                    g.apply_vjp(raw.lower[place(i) + 3 + k], t.qq[i][k], rest[i], g_t.qq[i][k], g_rest[i]);
            }
            g.finish(g_t.qq[k][k]);
            out.scales[3 + k] = bounded_softplus_vjp(raw.scales[3 + k], size[3 + k], g.first);
            GSB_UNROLL for (int j = 0; j < 3; ++j) g_rest[k][j] = g.rest[j];
        }
        GSB_UNROLL for (int i = 0; i < K; ++i) {
            GSB_UNROLL for (int j = 0; j < 3; ++j) out.lower[place(i) + j] = g_rest[i][j];
        }
        T g_size[3];
        SkewTurn<T>(raw.skew).vjp(g_pp, size, out.skew, g_size);
        GSB_UNROLL for (int j = 0; j < 3; ++j) out.scales[j] = bounded_softplus_vjp(raw.scales[j], size[j], g_size[j]);
    }
};

}  // namespace GSB_ISA
}  // namespace gsb
