// A SIMD vector of eight doubles on any CPU, for results in float64: one AVX-512 register, two AVX registers, or four
// SSE or NEON registers. No product is fused with a sum, so that all instruction sets compute the same bits.
#pragma once

#include <cstdint>

#include "simd_pair.h"

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace gsb {
inline namespace GSB_ISA {

#if defined(__AVX512F__)
constexpr int DOUBLE_WIDTH = 8;  // doubles in a register
#elif defined(__AVX2__)
constexpr int DOUBLE_WIDTH = 4;
#else
constexpr int DOUBLE_WIDTH = 2;
#endif
constexpr double LEAST_EXPONENT = -1000, MOST_EXPONENT = 1000;  // 2^x of these and what is between is a normal double

typedef double DoubleLanes __attribute__((vector_size(DOUBLE_WIDTH * 8)));
typedef int64_t LongLanes __attribute__((vector_size(DOUBLE_WIDTH * 8)));

struct DoubleRegisterMask {
    static constexpr int size = DOUBLE_WIDTH;
#if defined(__AVX512F__)
    using Bits = __mmask8;
#else
    using Bits = LongLanes;
#endif
    Bits m;

    GSB_HD friend DoubleRegisterMask operator&(DoubleRegisterMask a, DoubleRegisterMask b) { return {Bits(a.m & b.m)}; }
    GSB_HD friend DoubleRegisterMask operator|(DoubleRegisterMask a, DoubleRegisterMask b) { return {Bits(a.m | b.m)}; }
    GSB_HD friend DoubleRegisterMask operator!(DoubleRegisterMask a) { return {Bits(~a.m)}; }
    GSB_HD friend uint32_t bits(DoubleRegisterMask a) {
#if defined(__AVX512F__)
        return a.m;
#elif defined(__AVX2__)
        return static_cast<uint32_t>(_mm256_movemask_pd(reinterpret_cast<__m256d>(a.m)));
#elif defined(__x86_64__)
        return static_cast<uint32_t>(_mm_movemask_pd(reinterpret_cast<__m128d>(a.m)));
#else
        return (a.m[0] & 1u) | (a.m[1] & 2u);
#endif
    }
};

struct DoubleRegister {
    using Number = double;
    using Mask = DoubleRegisterMask;
    static constexpr int size = DOUBLE_WIDTH;
    DoubleLanes v;

    DoubleRegister() = default;
    GSB_HD DoubleRegister(DoubleLanes v) : v(v) {}
    GSB_HD DoubleRegister(double s) : v(s - DoubleLanes{}) {}

    GSB_HD static DoubleRegister load(const double* p) {
        DoubleRegister x;
        __builtin_memcpy(&x.v, p, sizeof(x.v));
        return x;
    }
    GSB_HD void store(double* p) const { __builtin_memcpy(p, &v, sizeof(v)); }

    GSB_HD friend DoubleRegister operator+(DoubleRegister a, DoubleRegister b) { return a.v + b.v; }
    GSB_HD friend DoubleRegister operator-(DoubleRegister a, DoubleRegister b) { return a.v - b.v; }
    GSB_HD friend DoubleRegister operator/(DoubleRegister a, DoubleRegister b) { return a.v / b.v; }
    GSB_HD friend DoubleRegister times(DoubleRegister a, DoubleRegister b) { return a.v * b.v; }
#if defined(__AVX512F__)
    GSB_HD friend Mask operator<(DoubleRegister a, DoubleRegister b) {
        return {_mm512_cmp_pd_mask(a.v, b.v, _CMP_LT_OQ)};
    }
    GSB_HD friend Mask operator<=(DoubleRegister a, DoubleRegister b) {
        return {_mm512_cmp_pd_mask(a.v, b.v, _CMP_LE_OQ)};
    }
    GSB_HD friend DoubleRegister select(Mask m, DoubleRegister yes, DoubleRegister no) {
        return DoubleLanes(_mm512_mask_mov_pd(no.v, m.m, yes.v));
    }
    GSB_HD friend DoubleRegister min(DoubleRegister a, DoubleRegister b) {
        return DoubleLanes(_mm512_min_pd(a.v, b.v));
    }
    GSB_HD friend DoubleRegister max(DoubleRegister a, DoubleRegister b) {
        return DoubleLanes(_mm512_max_pd(a.v, b.v));
    }
#else
    GSB_HD friend Mask operator<(DoubleRegister a, DoubleRegister b) { return {a.v < b.v}; }
    GSB_HD friend Mask operator<=(DoubleRegister a, DoubleRegister b) { return {a.v <= b.v}; }
    GSB_HD friend DoubleRegister select(Mask m, DoubleRegister yes, DoubleRegister no) { return m.m ? yes.v : no.v; }
    GSB_HD friend DoubleRegister min(DoubleRegister a, DoubleRegister b) { return a.v < b.v ? a.v : b.v; }
    GSB_HD friend DoubleRegister max(DoubleRegister a, DoubleRegister b) { return a.v > b.v ? a.v : b.v; }
#endif
    GSB_HD friend DoubleRegister sqrt(DoubleRegister a) {
#if defined(__AVX512F__)
        return DoubleLanes(_mm512_sqrt_pd(a.v));
#elif defined(__AVX2__)
        return DoubleLanes(_mm256_sqrt_pd(a.v));
#elif defined(__x86_64__)
        return DoubleLanes(_mm_sqrt_pd(a.v));
#else
        for (int i = 0; i < DOUBLE_WIDTH; ++i) a.v[i] = ::sqrt(a.v[i]);
        return a;
#endif
    }
    GSB_HD friend DoubleRegister abs(DoubleRegister a) {
        return reinterpret_cast<DoubleLanes>(reinterpret_cast<LongLanes>(a.v) & INT64_MAX);
    }
    // The integer that is nearest to x is in the last bits of the sum. A polynomial has the relative error 6e-16.
    GSB_HD friend DoubleRegister exp2(DoubleRegister x) {
        constexpr double no_fraction = 6755399441055744.0;  // 1.5 * 2^52
        const DoubleLanes bounded = min(max(x, LEAST_EXPONENT), MOST_EXPONENT).v, shifted = bounded + no_fraction;
        const DoubleLanes r = bounded - (shifted - no_fraction), r2 = r * r, r4 = r2 * r2;
        const DoubleLanes low =
            (1.0 + r * 0.693147180559946159) + r2 * (0.240226506959100761 + r * 0.055504108664651672);
        const DoubleLanes middle = (0.00961812910761866557 + r * 0.00133335582007945926) +
                                   r2 * (0.000154035304247765276 + r * 0.0000152526729248507364);
        const DoubleLanes high = (1.32154516322214344e-6 + r * 1.02059054137655958e-7) + r2 * 7.07097786650813856e-9;
        const DoubleLanes fraction = low + r4 * (middle + r4 * high);
        const LongLanes whole = reinterpret_cast<LongLanes>(shifted) << 52;  // added to the exponent
        return reinterpret_cast<DoubleLanes>(reinterpret_cast<LongLanes>(fraction) + whole);
    }
    // x = mantissa * 2^exponent, mantissa in [0.75, 1.5)
    GSB_HD friend void split(DoubleRegister x, DoubleRegister& mantissa, DoubleRegister& exponent) {
        const LongLanes raw = reinterpret_cast<LongLanes>(x.v), whole = (raw - 0x3fe8000000000000) >> 52;
        mantissa.v = reinterpret_cast<DoubleLanes>(raw - (whole << 52));
        exponent.v = __builtin_convertvector(whole, DoubleLanes);
    }
};

#if defined(__AVX512F__)
using Doubles = DoubleRegister;
#elif defined(__AVX2__)
using Doubles = Pair<DoubleRegister>;
#else
using Doubles = Pair<Pair<DoubleRegister>>;
#endif
using DoubleMask = Doubles::Mask;
constexpr int DOUBLES = Doubles::size;

template <class Half>
GSB_HD inline Pair<Half> abs(Pair<Half> a) {
    return {abs(a.lo), abs(a.hi)};
}

// Loads p[lane * stride] to the first n lanes, and zero to the others.
GSB_HD inline Doubles gather(const double* p, int stride, int n) {
    alignas(64) double lane[DOUBLES] = {};
    for (int i = 0; i < n; ++i) lane[i] = p[i * stride];
    return Doubles::load(lane);
}

GSB_HD inline Doubles operator*(Doubles a, Doubles b) { return times(a, b); }
GSB_HD inline Doubles operator-(Doubles a) { return Doubles(0.0) - a; }
GSB_HD inline Doubles& operator+=(Doubles& a, Doubles b) { return a = a + b; }
GSB_HD inline Doubles& operator-=(Doubles& a, Doubles b) { return a = a - b; }
GSB_HD inline DoubleMask operator>(Doubles a, Doubles b) { return b < a; }
GSB_HD inline DoubleMask operator>=(Doubles a, Doubles b) { return b <= a; }
GSB_HD inline bool any(DoubleMask m) { return bits(m) != 0; }

// Computes log2 by the series of atanh on mantissas in [0.75, 1.5), with an error of a few roundings.
GSB_HD inline Doubles log2(Doubles x) {
    Doubles m, e;
    split(x, m, e);
    const Doubles s = (m - 1.0) / (m + 1.0), s2 = s * s;
    Doubles series(1.0 / 23);
    for (int k = 21; k > 0; k -= 2) series = series * s2 + 1.0 / k;
    return e + s * series * (2 * LOG2_E);
}

}  // namespace GSB_ISA
}  // namespace gsb
