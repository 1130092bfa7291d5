// One 4DGS Gaussian, over position and time with a rotated factor: its conditional 3D Gaussian at a time, and the
// gradients.
#pragma once

#include "parameters.h"
#include "slicing.h"
#include "triangular.h"

namespace gsb {
inline namespace GSB_ISA {

template <class T>
struct RotatedParameters {
    T mean[3], time, scales[4], left[4], right[4], opacity;  // log scales; the last a logit
    T lambda_t;                                              // in gradients only

    // Calls f(array, parameter) for all but the opacity, with the arrays of the parameters or of their gradients.
    template <class Arrays, class F>
    GSB_HD void each(const Arrays& a, F f) {
        f(a.means, mean);
        f(a.times, time);
        f(a.scales, scales);
        f(a.left_quats, left);
        f(a.right_quats, right);
    }
};

// The 4D rotation is R = M_left(l) M_right(r) (4DGS eq. 7). Entry (i, j) of either matrix is entry (i xor j) of its
// quaternion, with a sign from these tables. The tables are inside functions, because arrays at namespace scope are not
// available on a GPU.
GSB_HD constexpr float LEFT_SIGN(int i, int j) {
    constexpr float table[4][4] = {{1, -1, -1, -1}, {1, 1, -1, 1}, {1, 1, 1, -1}, {1, -1, 1, 1}};
    return table[i][j];
}
GSB_HD constexpr float RIGHT_SIGN(int i, int j) {
    constexpr float table[4][4] = {{1, 1, 1, 1}, {-1, 1, -1, 1}, {-1, 1, 1, -1}, {-1, -1, 1, 1}};
    return table[i][j];
}

// Returns the 3D rotation of a static 4D Gaussian, as a quaternion, from its left quaternion l. M_left(l) M_right(r)
// keeps the time axis fixed only for the right quaternion r = (l0, -l1, -l2, l3), and then it rotates space by this 3D
// rotation. The function is its own inverse, so it also maps the gradient back.
template <class T>
GSB_HD inline void turn_of_space(const T (&left)[4], T (&quat)[4]) {
    quat[0] = left[0];
    quat[1] = left[3];
    quat[2] = T(0.0f) - left[2];
    quat[3] = left[1];
}

template <class T>
struct RotatedGaussian {
    const RotatedParameters<T>& raw;
    float lambda_t, observed;
    UnitQuaternion<T> left, right;
    T L[4][4], R[4][4], F[4][4], size[4];  // F = L R diag(size), rows (x, y, z, t)
    T leads[4];                            // 1 for the column that is largest in t, else 0
    Reflections<T, 1> reflections;
    Reduced<T, 1> t;
    T white[1], opacity_factor, opacity;

    GSB_HD RotatedGaussian(const RotatedParameters<T>& raw, float lambda_t, float time)
        : raw(raw), lambda_t(lambda_t), observed(time), left(raw.left), right(raw.right) {}

    GSB_HD Observed<T> observe() {
        const T zero(0.0f);
        GSB_UNROLL for (int i = 0; i < 4; ++i) {
            size[i] = size_of(raw.scales[i]);
            GSB_UNROLL for (int j = 0; j < 4; ++j) {
                L[i][j] = left.q[i ^ j] * LEFT_SIGN(i, j);
                R[i][j] = right.q[i ^ j] * RIGHT_SIGN(i, j);
            }
        }
        for (int i = 0; i < 4; ++i) {
            for (int j = 0; j < 4; ++j) {
                T sum = zero;
                for (int k = 0; k < 4; ++k) sum = sum + L[i][k] * R[k][j];
                F[i][j] = sum * size[j];
            }
        }
        lead();
        T rows[4][4];  // t, then p
        for (int i = 0; i < 4; ++i) {
            for (int j = 0; j < 4; ++j) rows[(i + 1) % 4][j] = F[i][j];
        }
        swap_columns(rows);
        reflections.reduce(rows, t);
        const T delta[1] = {T(observed) - raw.time};
        whiten(t, delta, white);
        opacity_factor = exp(T(white[0] * white[0] * (-0.5f * lambda_t)));
        // A Gaussian that is culled keeps its mean, so that huge numbers do not reach a gradient.
        const auto seen = opacity_factor > T(TIME_OPACITY_FACTOR_MIN);
        opacity_factor = select(seen, opacity_factor, zero);
        white[0] = select(seen, white[0], zero);
        t.qq[0][0] = select(seen, t.qq[0][0], T(1.0f));
        opacity = sigmoid(raw.opacity);

        Observed<T> out;
        move_mean(t, raw.mean, white, out.mean);
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) out.factor[i][j] = t.pp[i][j];
        }
        out.opacity = opacity * opacity_factor;
        return out;
    }

    // Computes the gradients of the parameters; call it after `observe`.
    GSB_HD void vjp(const Observed<T>& g, RotatedParameters<T>& out) const {
        const T zero(0.0f);
        Reduced<T, 1> g_t;
        g_t.zero();
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) g_t.pp[i][j] = g.factor[i][j];
            out.mean[i] = g.mean[i];
        }
        out.opacity = g.opacity * opacity_factor * opacity * (T(1.0f) - opacity);
        const T g_exponent = zero - g.opacity * opacity * opacity_factor;
        out.lambda_t = g_exponent * white[0] * white[0] * 0.5f;
        T g_white[1] = {g_exponent * white[0] * lambda_t};
        move_mean_vjp(t, white, g.mean, g_white, g_t);
        g_white[0] = select(opacity_factor > zero, g_white[0], zero);
        whiten_vjp(t, white, g_white, g_t);  // now that of delta
        out.time = zero - g_white[0];
        T g_rows[4][4], g_M[4][4], g_left[4] = {zero, zero, zero, zero}, g_right[4] = {zero, zero, zero, zero};
        reflections.vjp(g_t, g_rows);
        swap_columns(g_rows);
        for (int j = 0; j < 4; ++j) {
            T along = zero;  // the gradient of log size is that of F's column along the column itself
            for (int i = 0; i < 4; ++i) {
                along = along + g_rows[(i + 1) % 4][j] * F[i][j];
                g_M[i][j] = g_rows[(i + 1) % 4][j] * size[j];
            }
            out.scales[j] = size_vjp(raw.scales[j], T(1.0f), along);
        }
        for (int i = 0; i < 4; ++i) {
            for (int j = 0; j < 4; ++j) {
                T g_L = zero, g_R = zero;
                for (int k = 0; k < 4; ++k) {
                    g_L = g_L + g_M[i][k] * R[j][k];
                    g_R = g_R + L[k][i] * g_M[k][j];
                }
                g_left[i ^ j] = g_left[i ^ j] + g_L * LEFT_SIGN(i, j);
                g_right[i ^ j] = g_right[i ^ j] + g_R * RIGHT_SIGN(i, j);
            }
        }
        left.vjp(g_left, out.left);
        right.vjp(g_right, out.right);
    }

private:
    // If a Gaussian is long in time, the columns of F differ by factors of 10^7. A reflection is accurate in every
    // column, and not only in the largest one, if it starts with the column that has the largest entry in the row to be
    // cleared (Powell and Reid 1969; Cox and Higham 1998). F F^T does not depend on the order of columns.
    GSB_HD void lead() {
        const T zero(0.0f), one(1.0f);
        T most(-1.0f);
        GSB_UNROLL for (int j = 0; j < 4; ++j) most = max(most, max(F[3][j], zero - F[3][j]));
        T open(1.0f);
        GSB_UNROLL for (int j = 0; j < 4; ++j) {
            leads[j] = select(most <= max(F[3][j], zero - F[3][j]), open, zero);
            open = open - leads[j];
        }
    }

    // Swaps the first column with the one that has the largest entry in t; a second call undoes the first.
    GSB_HD void swap_columns(T (&rows)[4][4]) const {
        const T half(0.5f);
        GSB_UNROLL for (int j = 1; j < 4; ++j) {
            const auto swapped = leads[j] > half;
            GSB_UNROLL for (int i = 0; i < 4; ++i) {
                const T first = rows[i][0];
                rows[i][0] = select(swapped, rows[i][j], first);
                rows[i][j] = select(swapped, first, rows[i][j]);
            }
        }
    }
};

}  // namespace GSB_ISA
}  // namespace gsb
