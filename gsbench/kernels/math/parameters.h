// How raw parameters of all models are mapped: log sizes by exp, sizes by softplus, quaternions to rotations, entries
// below a factor's diagonal.
#pragma once

#include "off_diagonal.h"
#include "scalar.h"
#include "thresholds.h"

namespace gsb {
inline namespace GSB_ISA {

constexpr float LEAST_SIZE = 1.12535175e-7f, LARGEST_SIZE = 8886110.52f;  // e^+-LOG_SIZE_MAX

// The exp of a log size that is clamped to +-LOG_SIZE_MAX; the derivative is zero if the log size was clamped.
template <class T>
GSB_HD inline T size_of(T log) {
    return exp(clamp(log, T(-LOG_SIZE_MAX), T(LOG_SIZE_MAX)));
}

template <class T>
GSB_HD inline T size_vjp(T log, T size, T g) {
    return select(max(log, T(0.0f) - log) <= T(LOG_SIZE_MAX), g * size, T(0.0f));
}

// Computes ln(1 + e^x). Of small e^x, ln is computed by the series of atanh, because 1 + e^x would lose digits.
template <class T>
GSB_HD inline T softplus(T x) {
    const T u = exp(min(x, T(0.0f) - x)), s = u / (u + 2.0f), s2 = s * s;
    T y = s2 * (1.0f / 13.0f) + (1.0f / 11.0f);
    y = y * s2 + (1.0f / 9.0f);
    y = y * s2 + (1.0f / 7.0f);
    y = y * s2 + (1.0f / 5.0f);
    y = y * s2 + (1.0f / 3.0f);
    return max(x, T(0.0f)) + (s + s * s2 * y) * 2.0f;
}

// The size softplus(x), clamped to e^+-LOG_SIZE_MAX; the derivative is zero if the size was clamped.
template <class T>
GSB_HD inline T bounded_softplus(T x) {
    return clamp(softplus(x), T(LEAST_SIZE), T(LARGEST_SIZE));
}

template <class T>
GSB_HD inline T bounded_softplus_vjp(T x, T size, T g) {
    return select(size > T(LEAST_SIZE), select(size < T(LARGEST_SIZE), g * sigmoid(x), T(0.0f)), T(0.0f));
}

// Returns an entry below the diagonal of a triangular factor from its parameter. If `relative`, the parameter is in
// units of the diagonal entry of its row.
template <class T>
GSB_HD inline T entry_of(T x, T diagonal, OffDiagonal form, bool relative) {
    const T bounded = form == OffDiagonal::row_scaled ? sigmoid(x) * 2.0f - 1.0f : x;
    return relative ? bounded * diagonal : bounded;
}

// Returns the gradient of the parameter from the gradient g of the entry, and adds to the gradient of the diagonal
// entry.
template <class T>
GSB_HD inline T entry_vjp(T x, T diagonal, OffDiagonal form, bool relative, T g, T& g_diagonal) {
    if (form == OffDiagonal::row_scaled) {
        const T s = sigmoid(x);
        g_diagonal = g_diagonal + g * (s * 2.0f - 1.0f);
        return g * diagonal * s * (T(1.0f) - s) * 2.0f;
    }
    if (!relative) return g;
    g_diagonal = g_diagonal + g * x;
    return g * diagonal;
}

// A quaternion normalised to length 1, as by torch.nn.functional.normalize.
template <class T>
struct UnitQuaternion {
    T q[4], inverse_length;

    GSB_HD explicit UnitQuaternion(const T (&raw)[4]) {
        const T square = raw[0] * raw[0] + raw[1] * raw[1] + raw[2] * raw[2] + raw[3] * raw[3];
        inverse_length = T(1.0f) / max(sqrt(square), T(1e-12f));
        GSB_UNROLL for (int i = 0; i < 4; ++i) q[i] = raw[i] * inverse_length;
    }
    GSB_HD void vjp(const T (&g)[4], T (&out)[4]) const {
        const T along = g[0] * q[0] + g[1] * q[1] + g[2] * q[2] + g[3] * q[3];
        GSB_UNROLL for (int i = 0; i < 4; ++i) out[i] = (g[i] - along * q[i]) * inverse_length;
    }
};

}  // namespace GSB_ISA
}  // namespace gsb
