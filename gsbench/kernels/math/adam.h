// The Adam update of one number (Kingma & Ba 2015, algorithm 1).
#pragma once

#include "scalar.h"

namespace gsb {

struct AdamRule {
    float rate, beta1, beta2, eps;
    float unbias1, unbias2;  // 1 / (1 - beta1^step), 1 / sqrt(1 - beta2^step)
};

inline namespace GSB_ISA {

// Updates p by its gradient g; m and v are the running means of g and g^2.
template <class T>
GSB_HD inline void adam_update(const AdamRule& a, T g, T& p, T& m, T& v) {
    m = m + (g - m) * (1.0f - a.beta1);
    v = v * a.beta2 + g * g * (1.0f - a.beta2);
    p = p - (m * (a.rate * a.unbias1)) / (sqrt(v) * a.unbias2 + a.eps);
}

}  // namespace GSB_ISA
}  // namespace gsb
