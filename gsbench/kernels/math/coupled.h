// The motion of a Gaussian of direct conditioning (dGS, dBS) over a query q of direction and, if K = 4, time:
//   white = L^T delta       mean = mu_p + V_pq W L white       V_pq = s Theta / |Theta|
// with delta = q - mu_q, the factor L of the precision L L^T, weights W = diag(w) and the mean s of three sizes.
#pragma once

#include "parameters.h"

namespace gsb {
inline namespace GSB_ISA {

template <class T, int K>
struct CoupledParameters {
    static constexpr int PRECISIONS = K == 4 ? 7 : 6;
    T precision[PRECISIONS];  // of L: the lower triangle over direction, row by row, and the entry of time; logs on it
    T coupling[3 * K];        // Theta, row by row
};

template <class T, int K>
struct CoupledMotion {
    using Parameters = CoupledParameters<T, K>;
    static constexpr int D = 3, TIME = 3;  // columns of direction; the column of time

    const Parameters& raw;
    T delta[K], weights[K], mean_size;
    T L[D][D], L_tt;  // lower triangle
    T white[K], pulled[K], unit[3 * K], inverse_length, shift[3];  // pulled: L white; shift: of the mean, over s

    GSB_HD CoupledMotion(const Parameters& raw, const T (&delta_)[K], const T (&weights_)[K], T mean_size)
        : raw(raw), mean_size(mean_size) {
        const T zero(0.0f);
        T square = zero;
        GSB_UNROLL for (int k = 0; k < K; ++k) {
            delta[k] = delta_[k];
            weights[k] = weights_[k];
        }
        GSB_UNROLL for (int i = 0; i < D; ++i) {
            GSB_UNROLL for (int j = 0; j <= i; ++j) {
                const T x = raw.precision[place(i, j)];
                L[i][j] = j == i ? size_of(x) : x;
            }
        }
        GSB_UNROLL for (int j = 0; j < D; ++j) {
            white[j] = zero;
            GSB_UNROLL for (int i = j; i < D; ++i) white[j] = white[j] + L[i][j] * delta[i];
        }
        GSB_UNROLL for (int i = 0; i < D; ++i) {
            pulled[i] = zero;
            GSB_UNROLL for (int j = 0; j <= i; ++j) pulled[i] = pulled[i] + L[i][j] * white[j];
        }
        if constexpr (K > D) {
            L_tt = size_of(raw.precision[place(TIME, 0)]);
            white[TIME] = L_tt * delta[TIME];
            pulled[TIME] = L_tt * white[TIME];
        }
        GSB_UNROLL for (int k = 0; k < 3 * K; ++k) square = square + raw.coupling[k] * raw.coupling[k];
        inverse_length = T(1.0f) / max(sqrt(square), T(1e-12f));
        GSB_UNROLL for (int i = 0; i < 3; ++i) {
            shift[i] = zero;
            GSB_UNROLL for (int k = 0; k < K; ++k) {
                unit[i * K + k] = raw.coupling[i * K + k] * inverse_length;
                shift[i] = shift[i] + unit[i * K + k] * (weights[k] * pulled[k]);
            }
        }
    }

    // Computes the gradients of the parameters, weights and delta, from those of the mean and `white`. Returns that of
    // the mean size.
    GSB_HD T vjp(const T (&g_mean)[3], const T (&g_opacity_white)[K], Parameters& out, T (&g_weights)[K],
                 T (&g_delta)[K]) const {
        const T zero(0.0f);
        const T g_size = g_mean[0] * shift[0] + g_mean[1] * shift[1] + g_mean[2] * shift[2];
        const T along = g_size * mean_size;  // the part of the gradient of `unit` along `unit`
        T g_pulled[K], g_white[K];
        GSB_UNROLL for (int k = 0; k < K; ++k) {
            T g_weighted = zero;
            GSB_UNROLL for (int i = 0; i < 3; ++i) {
                const T g_shift = g_mean[i] * mean_size;
                g_weighted = g_weighted + g_shift * unit[i * K + k];
                out.coupling[i * K + k] = (g_shift * (weights[k] * pulled[k]) - along * unit[i * K + k]) * inverse_length;
            }
            g_weights[k] = g_weighted * pulled[k];
            g_pulled[k] = g_weighted * weights[k];
        }
        GSB_UNROLL for (int j = 0; j < D; ++j) {
            g_white[j] = g_opacity_white[j];
            GSB_UNROLL for (int i = j; i < D; ++i) g_white[j] = g_white[j] + L[i][j] * g_pulled[i];
        }
        GSB_UNROLL for (int i = 0; i < D; ++i) {
            g_delta[i] = zero;
            GSB_UNROLL for (int j = 0; j <= i; ++j) {
                const T g = g_pulled[i] * white[j] + delta[i] * g_white[j];
                g_delta[i] = g_delta[i] + L[i][j] * g_white[j];
                out.precision[place(i, j)] = j == i ? size_vjp(raw.precision[place(i, j)], L[i][j], g) : g;
            }
        }
        if constexpr (K > D) {
            const T g = g_opacity_white[TIME] + L_tt * g_pulled[TIME];
            g_delta[TIME] = L_tt * g;
            out.precision[place(TIME, 0)] = size_vjp(raw.precision[place(TIME, 0)], L_tt,
                                                     g_pulled[TIME] * white[TIME] + delta[TIME] * g);
        }
        return g_size;
    }

private:
    GSB_HD static constexpr int place(int i, int j) { return i * (i + 1) / 2 + j; }
};

}  // namespace GSB_ISA
}  // namespace gsb
