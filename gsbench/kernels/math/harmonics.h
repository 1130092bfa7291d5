// Colours from real spherical harmonics of the viewing direction (3DGS), times a Fourier series in time (4DGS eq. 12).
#pragma once

#include <cstdint>

#include "scalar.h"
#include "sizes.h"

namespace gsb {
inline namespace GSB_ISA {

constexpr float SH_0 = 0.28209479177387814f, SH_1 = 0.4886025119029199f;

// The tables are inside functions, because arrays at namespace scope are not available on a GPU.
GSB_HD constexpr float SH_2(int m) {
    constexpr float table[5] = {1.0925484305920792f, -1.0925484305920792f, 0.31539156525252005f, -1.0925484305920792f,
                                0.5462742152960396f};
    return table[m];
}
GSB_HD constexpr float SH_3(int m) {
    constexpr float table[7] = {-0.5900435899266435f, 2.890611442640554f,  -0.4570457994644658f, 0.3731763325901154f,
                                -0.4570457994644658f, 1.445305721320277f, -0.5900435899266435f};
    return table[m];
}

// Evaluates Y_lm up to `degree` at a unit direction, in the order and signs of 3DGS; returns their number.
template <class T>
GSB_HD inline int harmonics(const Vec3<T>& d, int degree, T (&Y)[MAX_BASIS]) {
    const T x = d.x, y = d.y, z = d.z;
    Y[0] = T(SH_0);
    if (degree > 0) {
        Y[1] = y * -SH_1;
        Y[2] = z * SH_1;
        Y[3] = x * -SH_1;
    }
    const T xx = x * x, yy = y * y, zz = z * z;
    if (degree > 1) {
        Y[4] = x * y * SH_2(0);
        Y[5] = y * z * SH_2(1);
        Y[6] = (zz * 2.0f - xx - yy) * SH_2(2);
        Y[7] = x * z * SH_2(3);
        Y[8] = (xx - yy) * SH_2(4);
    }
    if (degree > 2) {
        Y[9] = y * (xx * 3.0f - yy) * SH_3(0);
        Y[10] = x * y * z * SH_3(1);
        Y[11] = y * (zz * 4.0f - xx - yy) * SH_3(2);
        Y[12] = z * (zz * 2.0f - (xx + yy) * 3.0f) * SH_3(3);
        Y[13] = x * (zz * 4.0f - xx - yy) * SH_3(4);
        Y[14] = z * (xx - yy) * SH_3(5);
        Y[15] = x * (xx - yy * 3.0f) * SH_3(6);
    }
    return (degree + 1) * (degree + 1);
}

// Returns the gradient of the direction from the gradient g of Y.
template <class T>
GSB_HD inline Vec3<T> harmonics_vjp(const Vec3<T>& d, int degree, const T (&g)[MAX_BASIS]) {
    const T x = d.x, y = d.y, z = d.z;
    Vec3<T> out{T(0.0f), T(0.0f), T(0.0f)};
    if (degree > 0) out = {g[3] * -SH_1, g[1] * -SH_1, g[2] * SH_1};
    if (degree > 1) {
        const T g4 = g[4] * SH_2(0), g5 = g[5] * SH_2(1), g6 = g[6] * (2.0f * SH_2(2)), g7 = g[7] * SH_2(3);
        const T g8 = g[8] * (2.0f * SH_2(4));
        out += {y * g4 + z * g7 + x * (g8 - g6), x * g4 + z * g5 - y * (g6 + g8), y * g5 + x * g7 + z * g6 * 2.0f};
    }
    if (degree > 2) {
        const T xx = x * x, yy = y * y, zz = z * z, xy = x * y, xz = x * z, yz = y * z;
        const T g9 = g[9] * SH_3(0), g10 = g[10] * SH_3(1), g11 = g[11] * SH_3(2), g12 = g[12] * SH_3(3);
        const T g13 = g[13] * SH_3(4), g14 = g[14] * SH_3(5), g15 = g[15] * SH_3(6);
        out += {xy * g9 * 6.0f + yz * g10 - xy * g11 * 2.0f - xz * g12 * 6.0f + (zz * 4.0f - xx * 3.0f - yy) * g13 +
                    xz * g14 * 2.0f + (xx - yy) * g15 * 3.0f,
                (xx - yy) * g9 * 3.0f + xz * g10 + (zz * 4.0f - xx - yy * 3.0f) * g11 - yz * g12 * 6.0f -
                    xy * g13 * 2.0f - yz * g14 * 2.0f - xy * g15 * 6.0f,
                xy * g10 + yz * g11 * 8.0f + (zz * 2.0f - xx - yy) * g12 * 3.0f + xz * g13 * 8.0f + (xx - yy) * g14};
    }
    return out;
}

// The SH degree and the number of frequencies in time of a colour; they are stored as the number degree + 4 (waves -
// 1).
struct ColorOrder {
    int degree, waves;

    GSB_HD static ColorOrder of(uint32_t number) {
        return {static_cast<int>(number % 4), static_cast<int>(number / 4) + 1};
    }
    GSB_HD int number() const { return degree + 4 * (waves - 1); }
    GSB_HD ColorOrder at_most(ColorOrder o) const {
        return {degree < o.degree ? degree : o.degree, waves < o.waves ? waves : o.waves};
    }
};

// A vector normalised to length 1. If it is too short to have a direction, the result and its gradient are zero.
template <class T>
struct Unit {
    Vec3<T> direction;
    T inverse_length;  // 0 where undefined

    GSB_HD explicit Unit(const Vec3<T>& v) {
        const T square = dot(v, v), one(1.0f);
        const auto defined = square > T(1e-20f);
        inverse_length = select(defined, one / sqrt(select(defined, square, one)), T(0.0f));
        direction = v * inverse_length;
    }
    GSB_HD Vec3<T> vjp(const Vec3<T>& g) const { return (g - direction * dot(direction, g)) * inverse_length; }
};

// Computes cos and sin of 2 pi x.
template <class T>
GSB_HD inline void circle(T x, T& cosine, T& sine) {
    const T half(0.5f), quarter(0.25f), zero(0.0f);
    const T r = x - round(x);                                         // [-1/2, 1/2]
    const T folded = select(r > quarter, half - r, select(r < zero - quarter, zero - half - r, r));  // same sine
    const T a = folded * 6.28318531f, s = a * a;                      // [-pi/2, pi/2]
    T odd = s * 2.60578066e-6f - 1.98096029e-4f;
    odd = odd * s + 8.33306625e-3f;
    odd = odd * s - 1.66666596e-1f;
    sine = a + a * s * odd;
    T even = s * -2.60770988e-7f + 2.47618859e-5f;
    even = even * s - 1.38884035e-3f;
    even = even * s + 4.16666407e-2f;
    even = even * s - 0.5f;
    cosine = even * s + 1.0f;
    cosine = select((r > quarter) | (r < zero - quarter), zero - cosine, cosine);
}

// Computes cos and sin of 2 pi n x for n = 0 .. waves - 1 by the addition theorem.
template <class T>
GSB_HD inline void waves_of(T x, int waves, T (&cosines)[MAX_WAVES], T (&sines)[MAX_WAVES]) {
    cosines[0] = T(1.0f);
    sines[0] = T(0.0f);
    if (waves < 2) return;
    circle(x, cosines[1], sines[1]);
    for (int n = 2; n < waves; ++n) {
        cosines[n] = cosines[n - 1] * cosines[1] - sines[n - 1] * sines[1];
        sines[n] = sines[n - 1] * cosines[1] + cosines[n - 1] * sines[1];
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
