// The conditional Gaussian as in the papers, for comparison with the square-root method: it forms S = F F^T and
// subtracts.
//
// A Cholesky factor of S with the rows of q first is [T_qq 0; T_pq T_pp], in which T_pp is the Cholesky factor of the
// conditional covariance S_pp - S_pq S_qq^-1 S_pq^T. The code solves where published code inverts, which is cheaper and
// loses the same digits (docs/stability.md).
#pragma once

#include "slicing.h"

namespace gsb {
inline namespace GSB_ISA {

template <class T, int K>
struct Subtraction {
    static constexpr bool KEEPS_REDUCED = false;
    static constexpr int N = K + 3;
    T F[N][N];     // what was given
    T C[N][N];     // lower triangle
    T inverse[N];  // 1 / C[j][j], 0 where S is not definite

    GSB_HD void reduce(const T (&rows)[N][N], Reduced<T, K>& t) {
        const T zero(0.0f), one(1.0f);
        for (int i = 0; i < N; ++i) {
            for (int j = 0; j < N; ++j) F[i][j] = rows[i][j];
        }
        for (int j = 0; j < N; ++j) {
            for (int i = j; i < N; ++i) {
                T left = zero;
                for (int k = 0; k < N; ++k) left = left + F[i][k] * F[j][k];
                for (int k = 0; k < j; ++k) left = left - C[i][k] * C[j][k];
                if (i == j) {
                    const auto definite = left > zero;
                    C[j][j] = select(definite, sqrt(select(definite, left, one)), zero);
                    inverse[j] = select(definite, one / select(definite, C[j][j], one), zero);
                } else {
                    C[i][j] = left * inverse[j];
                }
            }
        }
        t.zero();
        for (int i = 0; i < N; ++i) {
            for (int j = 0; j <= i; ++j) (i < K ? t.qq[i][j] : j < K ? t.pq[i - K][j] : t.pp[i - K][j - K]) = C[i][j];
        }
    }

    // Computes the gradient of `rows`.
    GSB_HD void vjp(const Reduced<T, K>& g_t, T (&g)[N][N]) const {
        T g_C[N][N];
        for (int i = 0; i < N; ++i) {
            for (int j = 0; j < N; ++j) {
                g[i][j] = T(0.0f);
                g_C[i][j] = i < K ? g_t.qq[i][j < K ? j : 0] : j < K ? g_t.pq[i - K][j] : g_t.pp[i - K][j - K];
            }
        }
        for (int j = N - 1; j >= 0; --j) {
            for (int i = N - 1; i >= j; --i) {
                if (i > j) g_C[j][j] = g_C[j][j] - g_C[i][j] * inverse[j] * C[i][j];
                const T g_S = g_C[i][j] * inverse[j] * (i == j ? 0.5f : 1.0f);
                for (int k = 0; k < j; ++k) {
                    g_C[i][k] = g_C[i][k] - g_S * C[j][k];
                    g_C[j][k] = g_C[j][k] - g_S * C[i][k];
                }
                for (int k = 0; k < N; ++k) {
                    g[i][k] = g[i][k] + g_S * F[j][k];
                    g[j][k] = g[j][k] + g_S * F[i][k];
                }
            }
        }
    }
};

}  // namespace GSB_ISA
}  // namespace gsb
