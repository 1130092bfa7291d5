// Sixteen floats at once on any CPU: one AVX-512 register, two of AVX, or four of SSE or NEON.
#pragma once

#include <cstdint>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

#include "../math/scalar.h"

namespace gsb {
inline namespace GSB_ISA {

constexpr int LANES = 16;

// The polynomial of least relative error (1.5e-7 in float) for 2^r, 0 <= r < 1, exact at 0.
template <class T>
inline T exp2_fraction(T r) {
    T y = r * 0.00186712993f + 0.00901703065f;
    y = y * r + 0.0557999129f;
    y = y * r + 0.24016445f;
    y = y * r + 0.693151312f;
    return y * r + 1.0f;
}

#if defined(__AVX512F__)

struct Mask {
    __mmask16 m;
};

struct Vec {
    __m512 v;

    Vec() = default;
    Vec(__m512 v) : v(v) {}
    Vec(float s) : v(_mm512_set1_ps(s)) {}

    static Vec load(const float* p) { return _mm512_loadu_ps(p); }
    void store(float* p) const { _mm512_storeu_ps(p, v); }
};

inline Vec operator+(Vec a, Vec b) { return _mm512_add_ps(a.v, b.v); }
inline Vec operator-(Vec a, Vec b) { return _mm512_sub_ps(a.v, b.v); }
inline Vec operator*(Vec a, Vec b) { return _mm512_mul_ps(a.v, b.v); }
inline Vec operator/(Vec a, Vec b) { return _mm512_div_ps(a.v, b.v); }
inline Mask operator<(Vec a, Vec b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LT_OQ)}; }
inline Mask operator<=(Vec a, Vec b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LE_OQ)}; }
inline Mask operator==(Vec a, Vec b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_EQ_OQ)}; }
inline Mask operator&(Mask a, Mask b) { return {static_cast<__mmask16>(a.m & b.m)}; }
inline Mask operator|(Mask a, Mask b) { return {static_cast<__mmask16>(a.m | b.m)}; }
inline Mask operator!(Mask a) { return {static_cast<__mmask16>(~a.m)}; }
inline bool any(Mask a) { return a.m != 0; }
inline uint32_t bits(Mask a) { return a.m; }
inline Vec select(Mask m, Vec yes, Vec no) { return _mm512_mask_mov_ps(no.v, m.m, yes.v); }
inline Vec min(Vec a, Vec b) { return _mm512_min_ps(a.v, b.v); }
inline Vec max(Vec a, Vec b) { return _mm512_max_ps(a.v, b.v); }
inline Vec sqrt(Vec a) { return _mm512_sqrt_ps(a.v); }

inline Vec reciprocal(Vec x) {  // 14 bits, and one step of Newton's
    const Vec y = _mm512_rcp14_ps(x.v);
    return y * (Vec(2.0f) - x * y);
}

inline Vec exp2(Vec x) {
    const Vec r = _mm512_reduce_ps(x.v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC);  // x - floor(x)
    return _mm512_scalef_ps(exp2_fraction(r).v, x.v);                                // times 2^floor(x)
}

// x = mantissa * 2^exponent, mantissa in [0.75, 1.5)
inline void split(Vec x, Vec& mantissa, Vec& exponent) {
    mantissa = _mm512_getmant_ps(x.v, _MM_MANT_NORM_p75_1p5, _MM_MANT_SIGN_zero);
    exponent = _mm512_getexp_ps((x / mantissa).v);
}

// p[lane * stride] of the first n lanes, zero in the others; and back.
inline __m512i strided(int stride) {
    return _mm512_mullo_epi32(_mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15),
                              _mm512_set1_epi32(stride));
}
inline __mmask16 first(int n) { return static_cast<__mmask16>((1u << n) - 1); }
inline Vec gather(const float* p, int stride, int n = LANES) {
    return _mm512_mask_i32gather_ps(_mm512_setzero_ps(), first(n), strided(stride), p, 4);
}
inline void scatter(Vec x, float* p, int stride, int n = LANES) {
    _mm512_mask_i32scatter_ps(p, first(n), strided(stride), x.v, 4);
}
inline void store_first(Vec x, float* p, int n) { _mm512_mask_storeu_ps(p, first(n), x.v); }

// The sums of four vectors' lanes, to out[0..3].
inline void sum4(Vec a, Vec b, Vec c, Vec d, float* out) {
    const __m512 ab = _mm512_add_ps(_mm512_shuffle_f32x4(a.v, b.v, 0x44), _mm512_shuffle_f32x4(a.v, b.v, 0xee));
    const __m512 cd = _mm512_add_ps(_mm512_shuffle_f32x4(c.v, d.v, 0x44), _mm512_shuffle_f32x4(c.v, d.v, 0xee));
    __m512 x = _mm512_add_ps(_mm512_shuffle_f32x4(ab, cd, 0x88), _mm512_shuffle_f32x4(ab, cd, 0xdd));
    x = _mm512_add_ps(x, _mm512_permute_ps(x, 0x4e));
    x = _mm512_add_ps(x, _mm512_permute_ps(x, 0xb1));  // each quarter holds one sum, four times
    const __m512i pick = _mm512_setr_epi32(0, 4, 8, 12, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0);
    _mm_storeu_ps(out, _mm512_castps512_ps128(_mm512_permutexvar_ps(pick, x)));
}

#else

#if defined(__AVX2__)
constexpr int PART = 8;
#else
constexpr int PART = 4;
#endif
constexpr int PARTS = LANES / PART;
typedef float FloatPart __attribute__((vector_size(PART * 4)));
typedef int32_t IntPart __attribute__((vector_size(PART * 4)));

struct Mask {
    IntPart m[PARTS];
};

struct Vec {
    FloatPart v[PARTS];

    Vec() = default;
    Vec(float s) {
        for (int i = 0; i < PARTS; ++i) {
#if defined(__AVX2__)
            v[i] = FloatPart{s, s, s, s, s, s, s, s};
#else
            v[i] = FloatPart{s, s, s, s};
#endif
        }
    }

    static Vec load(const float* p) {
        Vec x;
        __builtin_memcpy(&x, p, sizeof(x));
        return x;
    }
    void store(float* p) const { __builtin_memcpy(p, this, sizeof(*this)); }
};

template <class F>
inline Vec each(F f) {
    Vec x;
    for (int i = 0; i < PARTS; ++i) x.v[i] = f(i);
    return x;
}
template <class F>
inline Mask each_mask(F f) {
    Mask x;
    for (int i = 0; i < PARTS; ++i) x.m[i] = f(i);
    return x;
}

inline Vec operator+(Vec a, Vec b) { return each([&](int i) { return a.v[i] + b.v[i]; }); }
inline Vec operator-(Vec a, Vec b) { return each([&](int i) { return a.v[i] - b.v[i]; }); }
inline Vec operator*(Vec a, Vec b) { return each([&](int i) { return a.v[i] * b.v[i]; }); }
inline Vec operator/(Vec a, Vec b) { return each([&](int i) { return a.v[i] / b.v[i]; }); }
inline Mask operator<(Vec a, Vec b) { return each_mask([&](int i) { return a.v[i] < b.v[i]; }); }
inline Mask operator<=(Vec a, Vec b) { return each_mask([&](int i) { return a.v[i] <= b.v[i]; }); }
inline Mask operator==(Vec a, Vec b) { return each_mask([&](int i) { return a.v[i] == b.v[i]; }); }
inline Mask operator&(Mask a, Mask b) { return each_mask([&](int i) { return a.m[i] & b.m[i]; }); }
inline Mask operator|(Mask a, Mask b) { return each_mask([&](int i) { return a.m[i] | b.m[i]; }); }
inline Mask operator!(Mask a) { return each_mask([&](int i) { return ~a.m[i]; }); }
inline Vec select(Mask m, Vec yes, Vec no) { return each([&](int i) { return m.m[i] ? yes.v[i] : no.v[i]; }); }
inline Vec min(Vec a, Vec b) { return each([&](int i) { return a.v[i] < b.v[i] ? a.v[i] : b.v[i]; }); }
inline Vec max(Vec a, Vec b) { return each([&](int i) { return a.v[i] > b.v[i] ? a.v[i] : b.v[i]; }); }
inline Vec reciprocal(Vec x) { return Vec(1.0f) / x; }

inline uint32_t bits(Mask a) {
    uint32_t out = 0;
    for (int i = 0; i < PARTS; ++i) {
#if defined(__AVX2__)
        out |= static_cast<uint32_t>(_mm256_movemask_ps(reinterpret_cast<__m256>(a.m[i]))) << (i * PART);
#elif defined(__x86_64__)
        out |= static_cast<uint32_t>(_mm_movemask_ps(reinterpret_cast<__m128>(a.m[i]))) << (i * PART);
#else
        for (int lane = 0; lane < PART; ++lane) out |= (a.m[i][lane] & 1u) << (i * PART + lane);
#endif
    }
    return out;
}
inline bool any(Mask a) { return bits(a) != 0; }

inline Vec sqrt(Vec a) {
    for (int i = 0; i < LANES; ++i) a.v[i / PART][i % PART] = ::sqrtf(a.v[i / PART][i % PART]);
    return a;
}

inline Vec exp2(Vec x) {
    x = max(x, Vec(-126.0f));
    return each([&](int i) {
        IntPart whole = __builtin_convertvector(x.v[i], IntPart);  // towards zero: one too many below it
        FloatPart r = x.v[i] - __builtin_convertvector(whole, FloatPart);
        const IntPart below = r < 0.0f;  // -1 where so
        whole += below;
        r -= __builtin_convertvector(below, FloatPart);
        return exp2_fraction(r) * reinterpret_cast<FloatPart>((whole + 127) << 23);
    });
}

inline void split(Vec x, Vec& mantissa, Vec& exponent) {
    for (int i = 0; i < PARTS; ++i) {
        const IntPart raw = reinterpret_cast<IntPart>(x.v[i]);
        const IntPart whole = (raw - 0x3f400000) >> 23;  // 0x3f400000 is 0.75
        mantissa.v[i] = reinterpret_cast<FloatPart>(raw - (whole << 23));
        exponent.v[i] = __builtin_convertvector(whole, FloatPart);
    }
}

inline Vec gather(const float* p, int stride, int n = LANES) {
    Vec x(0.0f);
    for (int i = 0; i < n; ++i) x.v[i / PART][i % PART] = p[i * stride];
    return x;
}
inline void scatter(Vec x, float* p, int stride, int n = LANES) {
    for (int i = 0; i < n; ++i) p[i * stride] = x.v[i / PART][i % PART];
}
inline void store_first(Vec x, float* p, int n) { scatter(x, p, 1, n); }

inline void sum4(Vec a, Vec b, Vec c, Vec d, float* out) {
    const auto fold = [](const Vec& x) {
        FloatPart y = x.v[0];
        for (int i = 1; i < PARTS; ++i) y += x.v[i];
        return y;
    };
#if defined(__AVX2__)
    const __m256 ab = _mm256_hadd_ps(fold(a), fold(b)), cd = _mm256_hadd_ps(fold(c), fold(d));
    const __m256 x = _mm256_hadd_ps(ab, cd);
    _mm_storeu_ps(out, _mm_add_ps(_mm256_castps256_ps128(x), _mm256_extractf128_ps(x, 1)));
#else
    const FloatPart parts[4] = {fold(a), fold(b), fold(c), fold(d)};
    for (int i = 0; i < 4; ++i) out[i] = (parts[i][0] + parts[i][2]) + (parts[i][1] + parts[i][3]);
#endif
}

#endif

inline Vec operator-(Vec a) { return Vec(0.0f) - a; }
inline Vec& operator+=(Vec& a, Vec b) { return a = a + b; }
inline Vec& operator-=(Vec& a, Vec b) { return a = a - b; }
inline Mask operator>(Vec a, Vec b) { return b < a; }
inline Mask operator>=(Vec a, Vec b) { return b <= a; }

inline Vec load_first(const float* p, int n) { return n == LANES ? Vec::load(p) : gather(p, 1, n); }

// log2 by the series of atanh on mantissas in [0.75, 1.5): relative error 1e-7 where the result is not near zero.
inline Vec log2(Vec x) {
    Vec m, e;
    split(x, m, e);
    const Vec s = (m - 1.0f) / (m + 1.0f), s2 = s * s;
    Vec y = s2 * (1.0f / 9.0f) + (1.0f / 7.0f);
    y = y * s2 + (1.0f / 5.0f);
    y = y * s2 + (1.0f / 3.0f);
    y = y * s2 + 1.0f;
    return e + s * y * (2.0f * LOG2_E);
}

// The sum of the lanes, always in the same order.
inline float sum(Vec x) {
    alignas(64) float lane[LANES];
    x.store(lane);
    for (int half = LANES / 2; half > 0; half /= 2) {
        for (int i = 0; i < half; ++i) lane[i] += lane[i + half];
    }
    return lane[0];
}

}  // namespace GSB_ISA
}  // namespace gsb
