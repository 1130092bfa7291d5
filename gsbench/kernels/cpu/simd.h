// A SIMD vector of sixteen floats on any CPU: one AVX-512 register, two AVX registers, or four SSE or NEON registers.
#pragma once

#include <cstdint>

#include "../math/scalar.h"

namespace gsb {
inline namespace GSB_ISA {

constexpr int LANES = 16;
constexpr uint32_t ALL_LANES = 0xffff;
constexpr float EXP2_LEAST = -126.0f;  // 2^x of a smaller x is 2^-126, the smallest float with all its digits

// The polynomial with the smallest relative error (1.5e-7 in float) for 2^r with 0 <= r < 1, exact at 0.
template <class T>
GSB_HD inline T exp2_fraction(T r) {
    T y = times_plus(r, T(0.00186712993f), T(0.00901703065f));
    y = times_plus(y, r, T(0.0557999129f));
    y = times_plus(y, r, T(0.24016445f));
    y = times_plus(y, r, T(0.693151312f));
    return times_plus(y, r, T(1.0f));
}

}  // namespace GSB_ISA
}  // namespace gsb

#if defined(__AVX512F__)
#include "simd_avx512.h"
#else
#include "simd_moves.h"
#endif

namespace gsb {
inline namespace GSB_ISA {

// A product that is not rounded yet: a sum with it is rounded once (a fused multiply-add), if the CPU has that. So the
// source says what is fused and not the compiler, whose choice depends on the instruction set, and all instruction sets
// with a fused multiply-add compute the same bits. Of two products the first is fused.
struct Product {
    Vec a, b;

    GSB_HD operator Vec() const { return times(a, b); }
};
GSB_HD inline Product operator*(Vec a, Vec b) { return {a, b}; }
GSB_HD inline Vec operator+(Product x, Vec y) { return times_plus(x.a, x.b, y); }
GSB_HD inline Vec operator+(Vec x, Product y) { return times_plus(y.a, y.b, x); }
GSB_HD inline Vec operator+(Product x, Product y) { return x + Vec(y); }
GSB_HD inline Vec operator-(Product x, Vec y) { return times_minus(x.a, x.b, y); }
GSB_HD inline Vec operator-(Vec x, Product y) { return minus_times(x, y.a, y.b); }
GSB_HD inline Vec operator-(Product x, Product y) { return x - Vec(y); }

GSB_HD inline Vec operator-(Vec a) { return Vec(0.0f) - a; }
GSB_HD inline Vec& operator+=(Vec& a, Vec b) { return a = a + b; }
GSB_HD inline Vec& operator+=(Vec& a, Product b) { return a = a + b; }
GSB_HD inline Vec& operator-=(Vec& a, Vec b) { return a = a - b; }
GSB_HD inline Vec& operator-=(Vec& a, Product b) { return a = a - b; }
GSB_HD inline Mask operator>(Vec a, Vec b) { return b < a; }
GSB_HD inline Mask operator>=(Vec a, Vec b) { return b <= a; }

// Rounds to the nearest integer, for |x| < 2^22. The sum is so large that a float has no fraction, so the addition
// rounds.
GSB_HD inline Vec round(Vec x) {
    constexpr float no_fraction = 12582912.0f;  // 1.5 * 2^23
    return (x + no_fraction) - no_fraction;
}

GSB_HD inline Vec load_first(const float* p, int n) { return n == LANES ? Vec::load(p) : gather(p, 1, n); }

// Stores the first n lanes to p[offsets[lane]], as `gather_rows` loads them.
GSB_HD inline void scatter_rows(Vec x, float* p, const int32_t* offsets, int n) {
    alignas(64) float lane[LANES];
    x.store(lane);
    for (int i = 0; i < n; ++i) p[offsets[i]] = lane[i];
}

// Computes log2 by the series of atanh on mantissas in [0.75, 1.5), with relative error 1e-7 unless the result is near
// zero.
GSB_HD inline Vec log2(Vec x) {
    Vec m, e;
    split(x, m, e);
    const Vec s = (m - 1.0f) / (m + 1.0f), s2 = s * s;
    Vec y = s2 * (1.0f / 9.0f) + (1.0f / 7.0f);
    y = y * s2 + (1.0f / 5.0f);
    y = y * s2 + (1.0f / 3.0f);
    y = y * s2 + 1.0f;
    return e + s * y * Vec(2 * LOG2_E);
}

// The moves of colours, whose rows have three channels for each basis; simd_moves_avx2.h has faster ones.
#if defined(__AVX512F__) || !defined(__AVX2__)
// Returns y[at[i]] in lane i; at[i] is start + i / 3, at most 15.
GSB_HD inline Vec spread(const float* y, int, const int32_t* at) { return permute(Vec::load(y), at); }

// Returns x[j] + x[j + 1] + x[j + 2] in lane i, where j = at[i] is at most 12.
GSB_HD inline Vec sum_threes(Vec x, const int32_t* at) {
    alignas(64) constexpr int32_t next[LANES] = {1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 15};
    alignas(64) constexpr int32_t after[LANES] = {2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 15, 15};
    return permute(x + permute(x, next) + permute(x, after), at);
}
#endif

// Returns the sum of the lanes, always in the same order.
GSB_HD inline float sum(Vec x) {
    alignas(64) float lane[LANES];
    x.store(lane);
    for (int half = LANES / 2; half > 0; half /= 2) {
        for (int i = 0; i < half; ++i) lane[i] += lane[i + half];
    }
    return lane[0];
}

}  // namespace GSB_ISA
}  // namespace gsb
