// The conditional Gaussian computed on square roots (7DGS, section 4.2): from a joint Gaussian over a query q (time,
// direction or both) and position p, to the Gaussian over p at a given q.
//
// Reflections bring the rows of the joint factor to the form [T_qq 0; T_pq T_pp] with a lower triangular T_qq of size
// K:
//   white = T_qq^-1 (q - mu_q)        mean = mu_p + T_pq white        cov = T_pp T_pp^T
// A factor that is triangular in the row order (q, p) already has this form. Any other factor needs K reflections.
#pragma once

#include <cstdint>

#include "scalar.h"

namespace gsb {
inline namespace GSB_ISA {

// The camera centre and the time of a view.
struct ViewPoint {
    float center[3], time;
};

// Returns those of a view from the arguments of a slice; a time that the model does not have is 0.
template <class Args>
GSB_HD inline ViewPoint view_of(const Args& a, int64_t view = 0) {
    ViewPoint out{};
    if constexpr (requires { a.center; }) {
        GSB_UNROLL for (int k = 0; k < 3; ++k) out.center[k] = a.center[view * 3 + k];
    }
    if (a.time) out.time = a.time[view];
    return out;
}

// The reduced factor [T_qq 0; T_pq T_pp]: K rows of q, then three rows of p.
template <class T, int K>
struct Reduced {
    T qq[K][K];  // lower triangle
    T pq[3][K];
    T pp[3][3];

    GSB_HD void zero() {
        GSB_UNROLL for (int i = 0; i < K; ++i) {
            GSB_UNROLL for (int j = 0; j < K; ++j) qq[i][j] = T(0.0f);
        }
        GSB_UNROLL for (int i = 0; i < 3; ++i) {
            GSB_UNROLL for (int j = 0; j < K; ++j) pq[i][j] = T(0.0f);
            GSB_UNROLL for (int j = 0; j < 3; ++j) pp[i][j] = T(0.0f);
        }
    }
};

// Computes white = T_qq^-1 delta by forward substitution.
template <class T, int K>
GSB_HD inline void whiten(const Reduced<T, K>& t, const T (&delta)[K], T (&white)[K]) {
    GSB_UNROLL for (int i = 0; i < K; ++i) {
        T residual = delta[i];
        GSB_UNROLL for (int j = 0; j < i; ++j) residual = residual - t.qq[i][j] * white[j];
        white[i] = residual / t.qq[i][i];
    }
}

// The derivative of `whiten`: adds to g_t, and replaces g_white by the gradient of delta.
template <class T, int K>
GSB_HD inline void whiten_vjp(const Reduced<T, K>& t, const T (&white)[K], T (&g_white)[K], Reduced<T, K>& g_t) {
    GSB_UNROLL for (int i = K - 1; i >= 0; --i) {
        g_white[i] = g_white[i] / t.qq[i][i];
        GSB_UNROLL for (int j = 0; j < i; ++j) {
            g_white[j] = g_white[j] - t.qq[i][j] * g_white[i];
            g_t.qq[i][j] = g_t.qq[i][j] - g_white[i] * white[j];
        }
        g_t.qq[i][i] = g_t.qq[i][i] - g_white[i] * white[i];
    }
}

template <class T, int K>
GSB_HD inline void move_mean(const Reduced<T, K>& t, const T (&mean)[3], const T (&white)[K], T (&moved)[3]) {
    GSB_UNROLL for (int i = 0; i < 3; ++i) {
        moved[i] = mean[i];
        GSB_UNROLL for (int j = 0; j < K; ++j) moved[i] = moved[i] + t.pq[i][j] * white[j];
    }
}

// The derivative of `move_mean`: adds to g_white and g_t. The gradient of `mean` is g itself.
template <class T, int K>
GSB_HD inline void move_mean_vjp(const Reduced<T, K>& t, const T (&white)[K], const T (&g)[3], T (&g_white)[K],
                                 Reduced<T, K>& g_t) {
    GSB_UNROLL for (int i = 0; i < 3; ++i) {
        GSB_UNROLL for (int j = 0; j < K; ++j) {
            g_white[j] = g_white[j] + t.pq[i][j] * g[i];
            g_t.pq[i][j] = g_t.pq[i][j] + g[i] * white[j];
        }
    }
}

// K Householder reflections from the right, which make the first K of N = K + 3 rows lower triangular. The sign of each
// reflection avoids cancellation (Golub and Van Loan, section 5.1).
template <class T, int K>
struct Reflections {
    static constexpr bool KEEPS_REDUCED = true;  // what is in that form already may be left as it is
    static constexpr int N = K + 3;
    T before[K][N][N];  // what each reflection was given: its row first, then those below; from its column on
    T v[K][N];
    T step[K];  // 2 / v.v

    GSB_HD void reduce(const T (&rows)[N][N], Reduced<T, K>& t) {
        const T zero(0.0f), one(1.0f);
        T rest[N][N];
        GSB_UNROLL for (int i = 0; i < N; ++i) {
            GSB_UNROLL for (int j = 0; j < N; ++j) rest[i][j] = rows[i][j];
        }
        t.zero();
        GSB_UNROLL for (int k = 0; k < K; ++k) {
            T square = zero;
            GSB_UNROLL for (int j = k; j < N; ++j) square = square + rest[k][j] * rest[k][j];
            const T length = select(square > zero, sqrt(select(square > zero, square, one)), zero);
            const T signed_length = select(rest[k][k] < zero, zero - length, length);
            T vv = zero;
            GSB_UNROLL for (int j = k; j < N; ++j) {
                v[k][j] = j == k ? rest[k][j] + signed_length : rest[k][j];
                vv = vv + v[k][j] * v[k][j];
            }
            step[k] = T(2.0f) / select(vv > zero, vv, one);
            t.qq[k][k] = zero - signed_length;
            GSB_UNROLL for (int j = k; j < N; ++j) before[k][k][j] = rest[k][j];
            GSB_UNROLL for (int i = k + 1; i < N; ++i) {
                T along = zero;
                GSB_UNROLL for (int j = k; j < N; ++j) {
                    before[k][i][j] = rest[i][j];
                    along = along + rest[i][j] * v[k][j];
                }
                along = along * step[k];
                GSB_UNROLL for (int j = k; j < N; ++j) rest[i][j] = rest[i][j] - along * v[k][j];
                (i < K ? t.qq[i][k] : t.pq[i - K][k]) = rest[i][k];
            }
        }
        GSB_UNROLL for (int i = 0; i < 3; ++i) {
            GSB_UNROLL for (int j = 0; j < 3; ++j) t.pp[i][j] = rest[K + i][K + j];
        }
    }

    // Computes the gradient of `rows`.
    GSB_HD void vjp(const Reduced<T, K>& g_t, T (&g)[N][N]) const {
        const T zero(0.0f), one(1.0f);
        GSB_UNROLL for (int i = 0; i < N; ++i) {
            GSB_UNROLL for (int j = 0; j < N; ++j) {
                g[i][j] = i < K ? (j <= i ? g_t.qq[i][j] : zero) : j < K ? g_t.pq[i - K][j] : g_t.pp[i - K][j - K];
            }
        }
        GSB_UNROLL for (int k = K - 1; k >= 0; --k) {
            T g_v[N];
            GSB_UNROLL for (int j = k; j < N; ++j) g_v[j] = zero;
            GSB_UNROLL for (int i = k + 1; i < N; ++i) {
                T along = zero, g_along = zero;
                GSB_UNROLL for (int j = k; j < N; ++j) {
                    along = along + before[k][i][j] * v[k][j];
                    g_along = g_along + g[i][j] * v[k][j];
                }
                along = along * step[k];
                g_along = g_along * step[k];
                GSB_UNROLL for (int j = k; j < N; ++j) {
                    g_v[j] = g_v[j] - along * g[i][j] - g_along * before[k][i][j] + along * g_along * v[k][j];
                    g[i][j] = g[i][j] - g_along * v[k][j];
                }
            }
            // Row k became -signed_length; v is the row with signed_length added to its first entry.
            T square = zero;
            GSB_UNROLL for (int j = k; j < N; ++j) square = square + before[k][k][j] * before[k][k][j];
            const T first = before[k][k][k];
            const T inverse = select(square > zero, one / sqrt(select(square > zero, square, one)), zero);
            const T g_length = (g_v[k] - g[k][k]) * select(first < zero, zero - inverse, inverse);
            GSB_UNROLL for (int j = k; j < N; ++j) g[k][j] = g_v[j] + g_length * before[k][k][j];
        }
    }
};

}  // namespace GSB_ISA
}  // namespace gsb
