// What the slices of UBS and dBS share: 3D Gaussians with the exponent of a Beta profile, the factor (I + A) S, and the
// opacity factor.
#pragma once

#include "parameters.h"
#include "triangular.h"

namespace gsb {
inline namespace GSB_ISA {

// A conditional 3D Gaussian with the exponent of its Beta profile.
template <class T>
struct ObservedBeta : Observed<T> {
    T shape;
};

// The matrix I + A with a skew-symmetric A, a rotation to first order, and the gradients of (I + A) S with sizes S.
template <class T>
struct SkewTurn {
    T turn[3][3];

    // Takes A_01, A_02 and A_12.
    GSB_HD explicit SkewTurn(const T (&skew)[3]) {
        turn[0][0] = turn[1][1] = turn[2][2] = T(1.0f);
        GSB_UNROLL for (int k = 0; k < 3; ++k) {
            turn[row(k)][column(k)] = skew[k];
            turn[column(k)][row(k)] = T(0.0f) - skew[k];
        }
    }

    // Computes the gradients of the skew numbers and of the three sizes from that of the factor.
    GSB_HD void vjp(const T (&g)[3][3], const T* size, T (&g_skew)[3], T (&g_size)[3]) const {
        GSB_UNROLL for (int k = 0; k < 3; ++k) {
            g_skew[k] = g[row(k)][column(k)] * size[column(k)] - g[column(k)][row(k)] * size[row(k)];
            g_size[k] = g[0][k] * turn[0][k] + g[1][k] * turn[1][k] + g[2][k] * turn[2][k];
        }
    }

private:
    GSB_HD static constexpr int row(int k) { return k / 2; }           // of (0, 1), (0, 2), (1, 2)
    GSB_HD static constexpr int column(int k) { return (k + 3) / 2; }
};

// Exponents b = 4 exp(beta) of direction and time, and the weights min(b / 4, 1) by which these move the mean.
template <class T, int K>
struct BetaExponents {
    T exponents[K], weights[K];

    BetaExponents() = default;
    GSB_HD explicit BetaExponents(const T* betas) {
        GSB_UNROLL for (int i = 0; i < K; ++i) {
            exponents[i] = size_of(betas[i]) * 4.0f;
            weights[i] = min(exponents[i] * 0.25f, T(1.0f));
        }
    }

    GSB_HD void vjp(const T* betas, const T (&g_exponents)[K], const T (&g_weights)[K], T* out) const {
        GSB_UNROLL for (int i = 0; i < K; ++i) {
            const T g_capped = select(exponents[i] * 0.25f <= T(1.0f), g_weights[i] * 0.25f, T(0.0f));
            out[i] = size_vjp(betas[i], exponents[i], g_exponents[i] + g_capped);
        }
    }
};

// Computes ln(1 - tanh(y^2)), at least BETA_LOG_MIN. With x = y^2 it is -x - ln(cosh(x)); of small x by the series,
// because ln 2 - ln(1 + e^2x) would lose digits, which large exponents multiply.
template <class T>
GSB_HD inline T log_fading(T y) {
    const T x = min(y * y, T(EXPONENT_MAX)), x2 = x * x;
    T series = T(1.0f / 45.0f) - x2 * (17.0f / 2520.0f);
    series = T(1.0f / 12.0f) - x2 * series;
    series = T(0.5f) - x2 * series;
    return select(x < T(0.25f), T(0.0f) - (x + x2 * series), max(T(LN_2) - softplus(T(x * 2.0f)), T(BETA_LOG_MIN)));
}

// Returns the gradient of y from that of `log_fading`, which returned `log`.
template <class T>
GSB_HD inline T log_fading_vjp(T y, T log, T g) {
    return select(log > T(BETA_LOG_MIN), T(0.0f) - g * sigmoid(min(y * y * 2.0f, T(EXPONENT_MAX))) * y * 4.0f, T(0.0f));
}

// The opacity factor prod_i (1 - tanh(y_i^2))^b_i of a whitened query y and exponents b.
template <class T, int K>
struct BetaFading {
    T logs[K], factor;

    BetaFading() = default;
    GSB_HD BetaFading(const T (&white)[K], const T (&exponents)[K]) {
        T sum(0.0f);
        GSB_UNROLL for (int i = 0; i < K; ++i) {
            logs[i] = log_fading(white[i]);
            sum = sum + exponents[i] * logs[i];
        }
        factor = select(sum < T(-EXPONENT_MAX), T(0.0f), exp(max(sum, T(-EXPONENT_MAX))));
    }

    // Computes the gradients of `white` and `exponents` from that of the factor.
    GSB_HD void vjp(const T (&white)[K], const T (&exponents)[K], T g, T (&g_white)[K], T (&g_exponents)[K]) const {
        const T g_sum = g * factor;
        GSB_UNROLL for (int i = 0; i < K; ++i) {
            g_exponents[i] = g_sum * logs[i];
            g_white[i] = log_fading_vjp(white[i], logs[i], T(g_sum * exponents[i]));
        }
    }
};

}  // namespace GSB_ISA
}  // namespace gsb
