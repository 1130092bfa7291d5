// One Gaussian of 6DGS, 7DGS or 7DGS without direction, over position and direction, time or both with a triangular
// factor: its conditional 3D Gaussian, and the gradients.
#pragma once

#include "harmonics.h"
#include "parameters.h"
#include "subtraction.h"

namespace gsb {
inline namespace GSB_ISA {

// The variables on which a Gaussian is conditioned. Rows of direction come before rows of time.
enum class Query { direction, time, both };

// Calls run<Query>() for direction, time or both; at least one of them must be true.
template <class Run>
void observing(bool direction, bool time, Run run) {
    if (direction && time) return run.template operator()<Query::both>();
    time ? run.template operator()<Query::time>() : run.template operator()<Query::direction>();
}

// The values that are equal for all Gaussians of a model, and the camera centre and time.
struct TriangularModel {
    bool conditioned_first;  // rows of the factor are (d, t, p); else (p, t, d), as in the paper
    OffDiagonal form;        // how parameters map to entries below the diagonal
    float half;              // the constant in the exponent of f_dir: 1/2 (7DGS eq. 12) or 1 (6DGS)
    float lambda_d, lambda_t;
    float center[3], time;  // the camera centre and the time of the view
};

// The conditional 3D Gaussian, which the rasterizer gets.
template <class T>
struct Observed {
    T mean[3], factor[3][3], opacity;
};

template <class T, Query Q>
struct TriangularParameters {
    static constexpr bool DIRECTION = Q != Query::time, TIME = Q != Query::direction;
    static constexpr int TIME_ROW = DIRECTION ? 3 : 0, K = TIME_ROW + TIME, N = K + 3;
    static constexpr bool COUPLED = K > 1;  // otherwise `coupling` has no entries and is not used
    T mean[3], direction[3], time, log_diagonal[N];
    T shape[3], motion[3 * K], coupling[COUPLED ? K * (K - 1) / 2 : 1];  // row by row: `entry` says which is which
    T opacity;                                                           // a logit
    T lambda_d, lambda_t;                                                // in gradients only

    // Calls f(array, parameter) for all but the opacity, with the arrays of the parameters or of their gradients.
    template <class Arrays, class F>
    GSB_HD void each(const Arrays& a, F f) {
        f(a.means, mean);
        if constexpr (DIRECTION) f(a.directions, direction);
        if constexpr (TIME) f(a.times, time);
        f(a.log_diagonal, log_diagonal);
        f(a.shape, shape);
        f(a.motion, motion);
        if constexpr (COUPLED) f(a.coupling, coupling);
    }
};

template <class T, Query Q, template <class, int> class Reduction = Reflections>
struct TriangularGaussian {
    using Parameters = TriangularParameters<T, Q>;
    static constexpr bool DIRECTION = Parameters::DIRECTION, TIME = Parameters::TIME;
    static constexpr int TIME_ROW = Parameters::TIME_ROW, K = Parameters::K, N = Parameters::N;

    const TriangularModel& model;
    const Parameters& raw;
    T L[N][N];  // the factor, lower triangle
    Reduction<T, K> reduction;
    Reduced<T, K> t;
    Vec3<T> offset;  // camera to mean
    T white[K], delta_t, spread_t, opacity_factor, opacity;

    GSB_HD TriangularGaussian(const TriangularModel& model, const Parameters& raw) : model(model), raw(raw) {}

    // Returns the row of the factor that belongs to row i in the order (d, t, p).
    GSB_HD int row(int i) const { return model.conditioned_first ? i : i < TIME_ROW ? N - 3 + i : i < K ? 3 : i - K; }

    GSB_HD Observed<T> observe() {
        const T zero(0.0f);
        make_factor();
        if (is_reduced()) {
            GSB_UNROLL for (int i = 0; i < K; ++i) {
                GSB_UNROLL for (int j = 0; j < K; ++j) t.qq[i][j] = j <= i ? L[i][j] : zero;
            }
            GSB_UNROLL for (int i = 0; i < 3; ++i) {
                GSB_UNROLL for (int j = 0; j < K; ++j) t.pq[i][j] = L[K + i][j];
                GSB_UNROLL for (int j = 0; j < 3; ++j) t.pp[i][j] = j <= i ? L[K + i][K + j] : zero;
            }
        } else {
            T rows[N][N];
            GSB_UNROLL for (int i = 0; i < N; ++i) {
                GSB_UNROLL for (int j = 0; j < N; ++j) rows[i][j] = j <= row(i) ? L[row(i)][j] : zero;
            }
            reduction.reduce(rows, t);
        }
        T delta[K];
        if constexpr (DIRECTION) {
            offset = {raw.mean[0] - model.center[0], raw.mean[1] - model.center[1], raw.mean[2] - model.center[2]};
            const Vec3<T> d = Unit<T>(offset).direction;
            delta[0] = d.x - raw.direction[0];
            delta[1] = d.y - raw.direction[1];
            delta[2] = d.z - raw.direction[2];
        }
        if constexpr (TIME) delta[TIME_ROW] = T(model.time) - raw.time;
        whiten(t, delta, white);
        T exponent = zero;
        if constexpr (DIRECTION) exponent = squares_d() * (model.half * model.lambda_d);
        if constexpr (TIME) {
            spread_t = zero;
            GSB_UNROLL for (int j = 0; j < K; ++j) spread_t = spread_t + t.qq[TIME_ROW][j] * t.qq[TIME_ROW][j];
            spread_t = sqrt(spread_t);
            delta_t = delta[TIME_ROW] / spread_t;
            exponent = exponent + delta_t * delta_t * (0.5f * model.lambda_t);
        }
        // A Gaussian that is too far from the query (direction, time) to be seen keeps its mean, so that huge numbers
        // do not reach a gradient.
        const auto seen = exponent < T(EXPONENT_MAX);
        opacity_factor = select(seen, exp(zero - exponent), zero);
        GSB_UNROLL for (int i = 0; i < K; ++i) white[i] = select(seen, white[i], zero);
        if constexpr (TIME) delta_t = select(seen, delta_t, zero);
        opacity = sigmoid(raw.opacity);

        Observed<T> out;
        move_mean(t, raw.mean, white, out.mean);
        GSB_UNROLL for (int i = 0; i < 3; ++i) {
            GSB_UNROLL for (int j = 0; j < 3; ++j) out.factor[i][j] = t.pp[i][j];
        }
        out.opacity = opacity * opacity_factor;
        return out;
    }

    // Computes the gradients of the parameters; call it after `observe`.
    GSB_HD void vjp(const Observed<T>& g, Parameters& out) const {
        const T zero(0.0f);
        Reduced<T, K> g_t;
        g_t.zero();
        GSB_UNROLL for (int i = 0; i < 3; ++i) {
            GSB_UNROLL for (int j = 0; j < 3; ++j) g_t.pp[i][j] = g.factor[i][j];
        }
        out.opacity = g.opacity * opacity_factor * opacity * (T(1.0f) - opacity);
        const T g_exponent = zero - g.opacity * opacity * opacity_factor;
        out.lambda_d = zero;
        if constexpr (DIRECTION) out.lambda_d = g_exponent * squares_d() * model.half;
        T g_white[K];
        GSB_UNROLL for (int i = 0; i < K; ++i) {
            g_white[i] = i < TIME_ROW ? g_exponent * white[i] * (2.0f * model.half * model.lambda_d) : zero;
        }
        move_mean_vjp(t, white, g.mean, g_white, g_t);
        const auto seen = opacity_factor > zero;
        GSB_UNROLL for (int i = 0; i < K; ++i) g_white[i] = select(seen, g_white[i], zero);
        whiten_vjp(t, white, g_white, g_t);  // now that of delta
        out.lambda_t = out.time = zero;
        if constexpr (TIME) {
            out.lambda_t = g_exponent * delta_t * delta_t * 0.5f;
            const T g_distance = g_exponent * delta_t * model.lambda_t / spread_t;
            out.time = zero - g_white[TIME_ROW] - g_distance;
            const T g_spread = g_distance * delta_t / spread_t;
            GSB_UNROLL for (int j = 0; j < K; ++j) {
                g_t.qq[TIME_ROW][j] = g_t.qq[TIME_ROW][j] - g_spread * t.qq[TIME_ROW][j];
            }
        }
        GSB_UNROLL for (int i = 0; i < 3; ++i) out.mean[i] = g.mean[i];
        if constexpr (DIRECTION) {
            const Vec3<T> g_offset = Unit<T>(offset).vjp({g_white[0], g_white[1], g_white[2]});
            out.mean[0] = out.mean[0] + g_offset.x;
            out.mean[1] = out.mean[1] + g_offset.y;
            out.mean[2] = out.mean[2] + g_offset.z;
            GSB_UNROLL for (int i = 0; i < 3; ++i) out.direction[i] = zero - g_white[i];
        }
        factor_vjp(g_t, out);
    }

private:
    // Returns |white_d|^2, the squared Mahalanobis distance in direction.
    GSB_HD T squares_d() const { return white[0] * white[0] + white[1] * white[1] + white[2] * white[2]; }

    // Returns whether the factor already has the reduced form, so that the square-root method has nothing to compute.
    GSB_HD bool is_reduced() const { return model.conditioned_first && Reduction<T, K>::KEEPS_REDUCED; }

    // Returns the parameter of the entry (i, j) below the diagonal: one of `shape` if row and column both belong to p,
    // of `motion` if one of them does, and of `coupling` if neither does.
    template <bool FIRST, class P>
    GSB_HD static auto& entry(P& p, int i, int j) {
        constexpr int QUERY = FIRST ? 0 : 3, SPACE = FIRST ? K : 0;  // the first row of q, and of p
        const bool row_in_space = FIRST ? i >= K : i < 3, column_in_space = FIRST ? j >= K : j < 3;
        if (row_in_space && column_in_space) return p.shape[(i - SPACE) * (i - SPACE - 1) / 2 + j - SPACE];
        if (row_in_space) return p.motion[(i - SPACE) * K + j];
        if (column_in_space) return p.motion[(i - QUERY) * 3 + j];
        return p.coupling[(i - QUERY) * (i - QUERY - 1) / 2 + j - QUERY];
    }

    // Returns whether the parameter of the entry (i, j) is in units of the diagonal entry of its row.
    template <bool FIRST>
    GSB_HD bool is_relative(int i, int j) const {
        const bool is_shape = FIRST ? j >= K : i < 3;
        return model.form == OffDiagonal::row_scaled || (model.form == OffDiagonal::relative && is_shape);
    }

    GSB_HD void make_factor() { model.conditioned_first ? make_factor<true>() : make_factor<false>(); }

    template <bool FIRST>
    GSB_HD void make_factor() {
        GSB_UNROLL for (int i = 0; i < N; ++i) {
            L[i][i] = size_of(raw.log_diagonal[i]);
            GSB_UNROLL for (int j = 0; j < i; ++j) {
                L[i][j] = entry_of(entry<FIRST>(raw, i, j), L[i][i], model.form, is_relative<FIRST>(i, j));
            }
        }
    }

    GSB_HD void factor_vjp(const Reduced<T, K>& g_t, Parameters& out) const {
        T g_L[N][N];
        if (is_reduced()) {
            GSB_UNROLL for (int i = 0; i < N; ++i) {
                GSB_UNROLL for (int j = 0; j <= i; ++j) {
                    g_L[i][j] = i < K ? g_t.qq[i][j] : j < K ? g_t.pq[i - K][j] : g_t.pp[i - K][j - K];
                }
            }
        } else {
            T g_rows[N][N];
            reduction.vjp(g_t, g_rows);
            GSB_UNROLL for (int i = 0; i < N; ++i) {
                GSB_UNROLL for (int j = 0; j < N; ++j) {
                    if (j <= row(i)) g_L[row(i)][j] = g_rows[i][j];
                }
            }
        }
        model.conditioned_first ? entries_vjp<true>(g_L, out) : entries_vjp<false>(g_L, out);
    }

    template <bool FIRST>
    GSB_HD void entries_vjp(const T (&g_L)[N][N], Parameters& out) const {
        GSB_UNROLL for (int i = 0; i < N; ++i) {
            T g_diagonal = g_L[i][i];
            GSB_UNROLL for (int j = 0; j < i; ++j) {
                entry<FIRST>(out, i, j) = entry_vjp(entry<FIRST>(raw, i, j), L[i][i], model.form,
                                                    is_relative<FIRST>(i, j), g_L[i][j], g_diagonal);
            }
            out.log_diagonal[i] = size_vjp(raw.log_diagonal[i], L[i][i], g_diagonal);
        }
    }
};

}  // namespace GSB_ISA
}  // namespace gsb
