// The SIMD vector of sixteen floats as two AVX registers, or as four SSE or NEON registers, built from pairs of halves.
#pragma once

#include <cstdint>

#include "simd_pair.h"

#if defined(__x86_64__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

namespace gsb {
inline namespace GSB_ISA {

#if defined(__AVX2__)
constexpr int WIDTH = 8;  // floats in a register
#else
constexpr int WIDTH = 4;
#endif
typedef float Floats __attribute__((vector_size(WIDTH * 4)));
typedef int32_t Ints __attribute__((vector_size(WIDTH * 4)));

struct RegisterMask {
    static constexpr int size = WIDTH;
    Ints m;

    GSB_HD friend RegisterMask operator&(RegisterMask a, RegisterMask b) { return {a.m & b.m}; }
    GSB_HD friend RegisterMask operator|(RegisterMask a, RegisterMask b) { return {a.m | b.m}; }
    GSB_HD friend RegisterMask operator!(RegisterMask a) { return {~a.m}; }
    GSB_HD friend uint32_t bits(RegisterMask a) {
#if defined(__AVX2__)
        return static_cast<uint32_t>(_mm256_movemask_ps(reinterpret_cast<__m256>(a.m)));
#elif defined(__x86_64__)
        return static_cast<uint32_t>(_mm_movemask_ps(reinterpret_cast<__m128>(a.m)));
#else
        uint32_t out = 0;
        for (int i = 0; i < WIDTH; ++i) out |= (a.m[i] & 1u) << i;
        return out;
#endif
    }
};

struct Register {
    using Number = float;
    using Mask = RegisterMask;
    static constexpr int size = WIDTH;
    Floats v;

    Register() = default;
    GSB_HD Register(Floats v) : v(v) {}
#if defined(__AVX2__)
    GSB_HD Register(float s) : v{s, s, s, s, s, s, s, s} {}
#else
    GSB_HD Register(float s) : v{s, s, s, s} {}
#endif

    GSB_HD static Register load(const float* p) {
        Register x;
        __builtin_memcpy(&x.v, p, sizeof(x.v));
        return x;
    }
    GSB_HD void store(float* p) const { __builtin_memcpy(p, &v, sizeof(v)); }
    GSB_HD static Register gather(const float* p, int stride) {
        Register x;
        for (int i = 0; i < WIDTH; ++i) x.v[i] = p[i * stride];
        return x;
    }
    GSB_HD void scatter(float* p, int stride) const {
        for (int i = 0; i < WIDTH; ++i) p[i * stride] = v[i];
    }

    GSB_HD friend Register operator+(Register a, Register b) { return a.v + b.v; }
    GSB_HD friend Register operator-(Register a, Register b) { return a.v - b.v; }
    GSB_HD friend Register operator/(Register a, Register b) { return a.v / b.v; }
    GSB_HD friend Register times(Register a, Register b) { return a.v * b.v; }
#if defined(__AVX2__)
    GSB_HD friend Register times_plus(Register a, Register b, Register c) { return Floats(_mm256_fmadd_ps(a.v, b.v, c.v)); }
    GSB_HD friend Register times_minus(Register a, Register b, Register c) { return Floats(_mm256_fmsub_ps(a.v, b.v, c.v)); }
    GSB_HD friend Register minus_times(Register c, Register a, Register b) { return Floats(_mm256_fnmadd_ps(a.v, b.v, c.v)); }
#elif defined(__aarch64__)
    GSB_HD friend Register times_plus(Register a, Register b, Register c) { return Floats(vfmaq_f32(c.v, a.v, b.v)); }
    GSB_HD friend Register times_minus(Register a, Register b, Register c) { return Floats(vfmaq_f32(-c.v, a.v, b.v)); }
    GSB_HD friend Register minus_times(Register c, Register a, Register b) { return Floats(vfmsq_f32(c.v, a.v, b.v)); }
#else  // no fused multiply-add: the product is rounded, then the sum
    GSB_HD friend Register times_plus(Register a, Register b, Register c) { return a.v * b.v + c.v; }
    GSB_HD friend Register times_minus(Register a, Register b, Register c) { return a.v * b.v - c.v; }
    GSB_HD friend Register minus_times(Register c, Register a, Register b) { return c.v - a.v * b.v; }
#endif
    GSB_HD friend Mask operator<(Register a, Register b) { return {a.v < b.v}; }
    GSB_HD friend Mask operator<=(Register a, Register b) { return {a.v <= b.v}; }
    GSB_HD friend Mask operator==(Register a, Register b) { return {a.v == b.v}; }
    GSB_HD friend Register select(Mask m, Register yes, Register no) { return m.m ? yes.v : no.v; }
#if defined(__AVX2__)  // GCC makes a comparison and a blend of the operator ?:
    GSB_HD friend Register min(Register a, Register b) { return Floats(_mm256_min_ps(a.v, b.v)); }
    GSB_HD friend Register max(Register a, Register b) { return Floats(_mm256_max_ps(a.v, b.v)); }
#else
    GSB_HD friend Register min(Register a, Register b) { return a.v < b.v ? a.v : b.v; }
    GSB_HD friend Register max(Register a, Register b) { return a.v > b.v ? a.v : b.v; }
#endif
    GSB_HD friend Register sqrt(Register a) {
#if defined(__AVX2__)
        return Floats(_mm256_sqrt_ps(a.v));
#elif defined(__x86_64__)
        return Floats(_mm_sqrt_ps(a.v));
#else
        for (int i = 0; i < WIDTH; ++i) a.v[i] = ::sqrtf(a.v[i]);
        return a;
#endif
    }
    GSB_HD friend Register exp2(Register x) {
        const Floats bounded = max(x, Register(EXP2_LEAST)).v;
#if defined(__AVX2__)
        const Floats floor = _mm256_floor_ps(bounded), r = bounded - floor;
        const Ints whole = __builtin_convertvector(floor, Ints);
#else
        Ints whole = __builtin_convertvector(bounded, Ints);  // towards zero: one too many below it
        Floats r = bounded - __builtin_convertvector(whole, Floats);
        const Ints below = r < 0.0f;  // -1 where so
        whole += below;
        r -= __builtin_convertvector(below, Floats);
#endif
        return exp2_fraction(Register(r)).v * reinterpret_cast<Floats>((whole + 127) << 23);
    }
    GSB_HD friend void split(Register x, Register& mantissa, Register& exponent) {
        const Ints raw = reinterpret_cast<Ints>(x.v), whole = (raw - 0x3f400000) >> 23;  // 0x3f400000 is 0.75
        mantissa.v = reinterpret_cast<Floats>(raw - (whole << 23));
        exponent.v = __builtin_convertvector(whole, Floats);
    }
};

#if defined(__AVX2__)
using Vec = Pair<Register>;
#else
using Vec = Pair<Pair<Register>>;
#endif
using Mask = Vec::Mask;
static_assert(Vec::size == LANES);

// Returns x, whose lanes 8 to 15 equal its lanes 0 to 7; what is computed of it is then computed for one half only.
GSB_HD inline Vec same_rows(Vec x) { return {x.lo, x.lo}; }

// Returns -|x| in lanes of the mask m, and x in the others.
GSB_HD inline Vec negative_where(Mask m, Vec x) { return select(m, min(x, Vec(0.0f) - x), x); }
GSB_HD inline void store_where(Mask m, Vec x, float* p) { select(m, x, Vec::load(p)).store(p); }
GSB_HD inline bool any(Mask m) { return bits(m) != 0; }

// Writes the lane sums of four vectors to out[0..3].
GSB_HD inline Floats fold(Register x) { return x.v; }
template <class Half>
GSB_HD inline Floats fold(Pair<Half> x) {
    return fold(x.lo + x.hi);
}
GSB_HD inline void sum4(Vec a, Vec b, Vec c, Vec d, float* out) {
#if defined(__AVX2__)
    const __m256 ab = _mm256_hadd_ps(fold(a), fold(b)), cd = _mm256_hadd_ps(fold(c), fold(d));
    const __m256 x = _mm256_hadd_ps(ab, cd);
    _mm_storeu_ps(out, _mm_add_ps(_mm256_castps256_ps128(x), _mm256_extractf128_ps(x, 1)));
#elif defined(__x86_64__)
    _mm_storeu_ps(out, _mm_hadd_ps(_mm_hadd_ps(fold(a), fold(b)), _mm_hadd_ps(fold(c), fold(d))));
#else
    const Floats parts[4] = {fold(a), fold(b), fold(c), fold(d)};
    for (int i = 0; i < 4; ++i) out[i] = (parts[i][0] + parts[i][1]) + (parts[i][2] + parts[i][3]);
#endif
}

}  // namespace GSB_ISA
}  // namespace gsb
