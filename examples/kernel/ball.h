// One ball: its factor r I and opacity, and backwards.
#pragma once

#include "parameters.h"

namespace gsb {
inline namespace GSB_ISA {

template <class T>
struct Ball {
    T log_radius, radius, opacity;

    GSB_HD Ball(T log_radius, T logit) : log_radius(log_radius), radius(size_of(log_radius)), opacity(sigmoid(logit)) {}

    GSB_HD void factor(T (&out)[3][3]) const {
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) out[i][j] = i == j ? radius : T(0.0f);
        }
    }
    GSB_HD T radius_vjp(const T (&g_factor)[3][3]) const {
        return size_vjp(log_radius, radius, g_factor[0][0] + g_factor[1][1] + g_factor[2][2]);
    }
    GSB_HD T opacity_vjp(T g) const { return g * opacity * (T(1.0f) - opacity); }
};

}  // namespace GSB_ISA
}  // namespace gsb
