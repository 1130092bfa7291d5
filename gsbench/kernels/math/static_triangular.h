// One Gaussian of 6DGS or 7DGS that is static (it does not change with camera or time): its 3D factor is the block
// L_pp.
#pragma once

#include "parameters.h"

namespace gsb {
inline namespace GSB_ISA {

template <class T>
struct StaticTriangularParameters {
    T log_diagonal[3], shape[3], opacity;  // of the rows of p; below the diagonal, row by row; a logit
};

template <class T>
struct StaticTriangularGaussian {
    const StaticTriangularParameters<T>& raw;
    OffDiagonal form;
    T factor[3][3], opacity;

    GSB_HD StaticTriangularGaussian(const StaticTriangularParameters<T>& raw, OffDiagonal form) : raw(raw), form(form) {
        GSB_UNROLL for (int i = 0; i < 3; ++i) {
            const T size = size_of(raw.log_diagonal[i]);
            GSB_UNROLL for (int j = 0; j < 3; ++j) {
                factor[i][j] = j < i ? entry_of(raw.shape[place(i, j)], size, form, is_relative()) : T(0.0f);
            }
            factor[i][i] = size;
        }
        opacity = sigmoid(raw.opacity);
    }

    GSB_HD void vjp(const T (&g_factor)[3][3], T g_opacity, StaticTriangularParameters<T>& out) const {
        GSB_UNROLL for (int i = 0; i < 3; ++i) {
            T g_size = g_factor[i][i];
            GSB_UNROLL for (int j = 0; j < i; ++j) {
                out.shape[place(i, j)] =
                    entry_vjp(raw.shape[place(i, j)], factor[i][i], form, is_relative(), g_factor[i][j], g_size);
            }
            out.log_diagonal[i] = size_vjp(raw.log_diagonal[i], factor[i][i], g_size);
        }
        out.opacity = g_opacity * opacity * (T(1.0f) - opacity);
    }

private:
    GSB_HD static constexpr int place(int i, int j) { return i * (i - 1) / 2 + j; }
    GSB_HD bool is_relative() const { return form != OffDiagonal::raw; }  // every entry within p is of the kind `shape`
};

}  // namespace GSB_ISA
}  // namespace gsb
