// What the slices of UBS and dBS share: 3D Gaussians with the exponent of a Beta profile, and the factor (I + A) S.
#pragma once

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

}  // namespace GSB_ISA
}  // namespace gsb
