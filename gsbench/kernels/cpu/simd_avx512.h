// The SIMD vector of sixteen floats as one AVX-512 register.
#pragma once

#include <immintrin.h>

#include <cstdint>

namespace gsb {
inline namespace GSB_ISA {

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

GSB_HD inline Vec operator+(Vec a, Vec b) { return _mm512_add_ps(a.v, b.v); }
GSB_HD inline Vec operator-(Vec a, Vec b) { return _mm512_sub_ps(a.v, b.v); }
GSB_HD inline Vec operator/(Vec a, Vec b) { return _mm512_div_ps(a.v, b.v); }
GSB_HD inline Vec times(Vec a, Vec b) { return _mm512_mul_ps(a.v, b.v); }
GSB_HD inline Vec times_plus(Vec a, Vec b, Vec c) { return _mm512_fmadd_ps(a.v, b.v, c.v); }    // a b + c
GSB_HD inline Vec times_minus(Vec a, Vec b, Vec c) { return _mm512_fmsub_ps(a.v, b.v, c.v); }   // a b - c
GSB_HD inline Vec minus_times(Vec c, Vec a, Vec b) { return _mm512_fnmadd_ps(a.v, b.v, c.v); }  // c - a b
GSB_HD inline Mask operator<(Vec a, Vec b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LT_OQ)}; }
GSB_HD inline Mask operator<=(Vec a, Vec b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LE_OQ)}; }
GSB_HD inline Mask operator==(Vec a, Vec b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_EQ_OQ)}; }
GSB_HD inline Mask operator&(Mask a, Mask b) { return {static_cast<__mmask16>(a.m & b.m)}; }
GSB_HD inline Mask operator|(Mask a, Mask b) { return {static_cast<__mmask16>(a.m | b.m)}; }
GSB_HD inline Mask operator!(Mask a) { return {static_cast<__mmask16>(~a.m)}; }
GSB_HD inline bool any(Mask a) { return a.m != 0; }
GSB_HD inline uint32_t bits(Mask a) { return a.m; }
GSB_HD inline Vec select(Mask m, Vec yes, Vec no) { return _mm512_mask_mov_ps(no.v, m.m, yes.v); }
// Returns x, whose lanes 8 to 15 equal its lanes 0 to 7; simd_halves.h says what for.
GSB_HD inline Vec same_rows(Vec x) { return x; }
// Returns -|x| in lanes of the mask m, and x in the others.
GSB_HD inline Vec negative_where(Mask m, Vec x) {
    const __m512i bits = _mm512_castps_si512(x.v);
    return _mm512_castsi512_ps(_mm512_mask_or_epi32(bits, m.m, bits, _mm512_set1_epi32(INT32_MIN)));
}
GSB_HD inline void store_where(Mask m, Vec x, float* p) { _mm512_mask_storeu_ps(p, m.m, x.v); }
GSB_HD inline Vec min(Vec a, Vec b) { return _mm512_min_ps(a.v, b.v); }
GSB_HD inline Vec max(Vec a, Vec b) { return _mm512_max_ps(a.v, b.v); }
GSB_HD inline Vec sqrt(Vec a) { return _mm512_sqrt_ps(a.v); }

GSB_HD inline Vec exp2(Vec x) {
    const __m512 bounded = _mm512_max_ps(x.v, _mm512_set1_ps(EXP2_LEAST));
    const __m512 whole = _mm512_roundscale_ps(bounded, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC);
    // A subtraction rounds to nearest, as with AVX2. `vreduceps`, which does both in one, rounds down.
    return _mm512_scalef_ps(exp2_fraction(Vec(_mm512_sub_ps(bounded, whole))).v, whole);
}

// x = mantissa * 2^exponent, mantissa in [0.75, 1.5)
GSB_HD inline void split(Vec x, Vec& mantissa, Vec& exponent) {
    const __m512i raw = _mm512_castps_si512(x.v), three_quarters = _mm512_set1_epi32(0x3f400000);
    const __m512i whole = _mm512_srai_epi32(_mm512_sub_epi32(raw, three_quarters), 23);
    mantissa = _mm512_castsi512_ps(_mm512_sub_epi32(raw, _mm512_slli_epi32(whole, 23)));
    exponent = _mm512_cvtepi32_ps(whole);
}

// Loads p[by] .. p[by + 15] with |by| < 16 by aligned loads from an aligned p, because a load that crosses cache lines
// takes twice as long.
template <int by>
GSB_HD inline Vec load_beside(const float* p) {
    const __m512i low = _mm512_load_si512(by < 0 ? p - LANES : p), high = _mm512_load_si512(by < 0 ? p : p + LANES);
    return _mm512_castsi512_ps(_mm512_alignr_epi32(high, low, by < 0 ? by + LANES : by));
}

GSB_HD inline __mmask16 first(int n) { return static_cast<__mmask16>((1u << n) - 1); }

// Loads the floats at(0) .. at(15) one by one, because gathers and scatters of AVX-512 take twice as long (on Zen 4, 81
// and 124 operations of the processor).
template <class At>
GSB_HD inline Vec collect(At at) {
    const __m256 low = _mm256_set_m128(_mm_setr_ps(at(4), at(5), at(6), at(7)), _mm_setr_ps(at(0), at(1), at(2), at(3)));
    const __m256 high =
        _mm256_set_m128(_mm_setr_ps(at(12), at(13), at(14), at(15)), _mm_setr_ps(at(8), at(9), at(10), at(11)));
    return _mm512_insertf32x8(_mm512_castps256_ps512(low), high, 1);
}

// Loads p[lane * stride] to the first n lanes, and zero to the others; `scatter` stores them.
GSB_HD inline Vec gather(const float* p, int stride, int n = LANES) {
    if (n == LANES) return collect([&](int i) { return p[i * stride]; });
    return collect([&](int i) { return i < n ? p[i * stride] : 0.0f; });
}
GSB_HD inline void scatter(Vec x, float* p, int stride, int n = LANES) {
    alignas(64) float lane[LANES];
    x.store(lane);
    if (n == LANES) {
        GSB_UNROLL for (int i = 0; i < LANES; ++i) p[i * stride] = lane[i];
    } else {
        for (int i = 0; i < n; ++i) p[i * stride] = lane[i];
    }
}

// Sixteen offsets for reading and writing p[offset] in the lanes whose mask bit is set.
struct Places {
    __m512i offset;

    GSB_HD explicit Places(const int32_t* p) : offset(_mm512_loadu_si512(p)) {}
};
GSB_HD inline Vec gather_at(const float* p, Places places, uint32_t bits) {
    return _mm512_mask_i32gather_ps(_mm512_setzero_ps(), static_cast<__mmask16>(bits), places.offset, p, 4);
}
GSB_HD inline void scatter_at(Vec x, float* p, Places places, uint32_t bits) {
    _mm512_mask_i32scatter_ps(p, static_cast<__mmask16>(bits), places.offset, x.v, 4);
}

// Stores four rows of four pixels with three channels; the rows are `stride` floats apart.
GSB_HD inline void store_rgb(Vec r, Vec g, Vec b, float* out, int64_t stride) {
    for (int row = 0; row < 4; ++row) {
        const __m512i at = _mm512_set1_epi32(4 * row);
        const __m512i rg = _mm512_setr_epi32(0, 16, 0, 1, 17, 0, 2, 18, 0, 3, 19, 0, 0, 0, 0, 0);
        const __m512i rgb = _mm512_add_epi32(_mm512_setr_epi32(0, 1, 16, 3, 4, 17, 6, 7, 18, 9, 10, 19, 0, 0, 0, 0),
                                             _mm512_maskz_mov_epi32(0x924, at));
        const __m512 two = _mm512_permutex2var_ps(r.v, _mm512_add_epi32(rg, at), g.v);
        _mm512_mask_storeu_ps(out + row * stride, 0xfff, _mm512_permutex2var_ps(two, rgb, b.v));
    }
}
GSB_HD inline void load_rgb(const float* in, int64_t stride, Vec (&channels)[3]) {
    __m512 rows[4];
    for (int row = 0; row < 4; ++row) rows[row] = _mm512_maskz_loadu_ps(0xfff, in + row * stride);
    for (int k = 0; k < 3; ++k) {
        const __m512i pick = _mm512_add_epi32(
            _mm512_setr_epi32(0, 3, 6, 9, 16, 19, 22, 25, 0, 3, 6, 9, 16, 19, 22, 25), _mm512_set1_epi32(k));
        channels[k] = _mm512_shuffle_f32x4(_mm512_permutex2var_ps(rows[0], pick, rows[1]),
                                           _mm512_permutex2var_ps(rows[2], pick, rows[3]), 0x44);
    }
}

// Loads p[offsets[lane]] to the first n lanes, and zero to the others; `scatter_rows` stores them.
GSB_HD inline Vec gather_rows(const float* p, const int32_t* offsets, int n) {
    if (n == LANES) return collect([&](int i) { return p[offsets[i]]; });
    return collect([&](int i) { return i < n ? p[offsets[i]] : 0.0f; });
}

// Returns the vector whose lane i is lane from[i] of x; `from` is aligned.
GSB_HD inline Vec permute(Vec x, const int32_t* from) {
    return _mm512_permutexvar_ps(_mm512_load_si512(from), x.v);
}

// Transposes sixteen rows of sixteen floats.
GSB_HD inline void transpose(Vec (&x)[LANES]) {
    __m512 a[LANES], b[LANES];
    for (int i = 0; i < LANES; i += 2) {
        a[i] = _mm512_unpacklo_ps(x[i].v, x[i + 1].v);
        a[i + 1] = _mm512_unpackhi_ps(x[i].v, x[i + 1].v);
    }
    for (int i = 0; i < LANES; i += 4) {
        for (int k = 0; k < 2; ++k) {
            b[i + 2 * k] = _mm512_shuffle_ps(a[i + k], a[i + k + 2], 0x44);
            b[i + 2 * k + 1] = _mm512_shuffle_ps(a[i + k], a[i + k + 2], 0xee);
        }
    }
    for (int i = 0; i < LANES; i += 8) {
        for (int k = 0; k < 4; ++k) {
            a[i + k] = _mm512_shuffle_f32x4(b[i + k], b[i + k + 4], 0x88);
            a[i + k + 4] = _mm512_shuffle_f32x4(b[i + k], b[i + k + 4], 0xdd);
        }
    }
    for (int k = 0; k < 8; ++k) {
        x[k] = _mm512_shuffle_f32x4(a[k], a[k + 8], 0x88);
        x[k + 8] = _mm512_shuffle_f32x4(a[k], a[k + 8], 0xdd);
    }
}

GSB_HD inline Vec load_some(const float* p, int n);
GSB_HD inline void store_first(Vec x, float* p, int n);

// For rows of W floats, W at most 4: lane l of column k is float l W + k of W registers, and float l of register k is
// lane (16 k + l) / W of column (16 k + l) % W.
template <int W>
struct Interleaved {
    alignas(64) int32_t float_of[W][LANES], lane_of[W][LANES];
    __mmask16 of_register[W][W], of_column[W][W];

    constexpr Interleaved() : float_of(), lane_of(), of_register(), of_column() {
        for (int k = 0; k < W; ++k) {
            for (int l = 0; l < LANES; ++l) {
                const int at = l * W + k, place = LANES * k + l;
                float_of[k][l] = at % LANES;
                of_register[k][at / LANES] |= static_cast<__mmask16>(1 << l);
                lane_of[k][l] = place / W;
                of_column[k][place % W] |= static_cast<__mmask16>(1 << l);
            }
        }
    }
};
template <int W>
constexpr Interleaved<W> INTERLEAVED{};

// Loads sixteen adjacent rows of W floats as W columns; `store_columns` stores them.
template <int W>
GSB_HD inline void load_columns(const float* p, Vec (&out)[W]) {
    if constexpr (W <= 4) {
        constexpr auto& to = INTERLEAVED<W>;
        Vec x[W];
        GSB_UNROLL for (int k = 0; k < W; ++k) x[k] = Vec::load(p + k * LANES);
        GSB_UNROLL for (int k = 0; k < W; ++k) {
            const __m512i at = _mm512_load_si512(to.float_of[k]);
            out[k] = _mm512_permutexvar_ps(at, x[0].v);
            GSB_UNROLL for (int j = 1; j < W; ++j) {
                out[k] = _mm512_mask_permutexvar_ps(out[k].v, to.of_register[k][j], at, x[j].v);
            }
        }
    } else {
        Vec x[LANES];
        GSB_UNROLL for (int i = 0; i < LANES; ++i) {
            x[i] = i * W + LANES <= LANES * W ? Vec::load(p + i * W) : load_some(p + i * W, W);
        }
        transpose(x);
        GSB_UNROLL for (int k = 0; k < W; ++k) out[k] = k < LANES ? x[k] : gather(p + k, W);
    }
}
template <int W>
GSB_HD inline void store_columns(const Vec (&x)[W], float* p) {
    if constexpr (W <= 4) {
        constexpr auto& to = INTERLEAVED<W>;
        GSB_UNROLL for (int k = 0; k < W; ++k) {
            const __m512i at = _mm512_load_si512(to.lane_of[k]);
            __m512 out = _mm512_permutexvar_ps(at, x[0].v);
            GSB_UNROLL for (int j = 1; j < W; ++j) {
                out = _mm512_mask_permutexvar_ps(out, to.of_column[k][j], at, x[j].v);
            }
            Vec(out).store(p + k * LANES);
        }
    } else {
        Vec rows[LANES];
        GSB_UNROLL for (int k = 0; k < LANES; ++k) rows[k] = k < W ? x[k] : Vec(0.0f);
        transpose(rows);
        // The excess lanes of a row are overwritten by the next row.
        GSB_UNROLL for (int i = 0; i < LANES; ++i) {
            i * W + LANES <= LANES * W ? rows[i].store(p + i * W) : store_first(rows[i], p + i * W, W);
        }
        GSB_UNROLL for (int k = LANES; k < W; ++k) scatter(x[k], p + k, W);
    }
}

// Loads the first n floats of p, and zero to the other lanes. With a mask, it may wait for stores to reach the cache.
GSB_HD inline Vec load_some(const float* p, int n) {
    return n == LANES ? Vec::load(p) : Vec(_mm512_maskz_loadu_ps(first(n), p));
}

// Returns the first n bytes as floats, and zero in the other lanes.
GSB_HD inline Vec load_bytes(const uint8_t* p, int n) {
    return _mm512_cvtepi32_ps(_mm512_cvtepu8_epi32(_mm_maskz_loadu_epi8(first(n), p)));
}

GSB_HD inline void store_first(Vec x, float* p, int n) {
    n == LANES ? x.store(p) : _mm512_mask_storeu_ps(p, first(n), x.v);
}

// Writes base + k for each bit k that is set, in order, and returns their number; up to 16 entries are overwritten.
GSB_HD inline int append_bits(uint32_t bits, uint32_t base, uint32_t* out) {
    const __m512i all = _mm512_add_epi32(_mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15),
                                         _mm512_set1_epi32(static_cast<int>(base)));
    _mm512_storeu_si512(out, _mm512_maskz_compress_epi32(static_cast<__mmask16>(bits), all));
    return __builtin_popcount(bits);
}

// Writes the lane sums of four vectors to out[0..3], in the same order as with AVX2: lane i + 8 to lane i, then neighbours.
GSB_HD inline void sum4(Vec a, Vec b, Vec c, Vec d, float* out) {
    const __m512 ab = _mm512_add_ps(_mm512_shuffle_f32x4(a.v, b.v, 0x44), _mm512_shuffle_f32x4(a.v, b.v, 0xee));
    const __m512 cd = _mm512_add_ps(_mm512_shuffle_f32x4(c.v, d.v, 0x44), _mm512_shuffle_f32x4(c.v, d.v, 0xee));
    __m512 x = _mm512_add_ps(_mm512_shuffle_ps(ab, cd, 0x88), _mm512_shuffle_ps(ab, cd, 0xdd));
    x = _mm512_add_ps(x, _mm512_permute_ps(x, 0xb1));
    x = _mm512_add_ps(x, _mm512_shuffle_f32x4(x, x, 0xb1));  // the sums of a and c, then those of b and d
    const __m512i pick = _mm512_setr_epi32(0, 8, 2, 10, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0);
    _mm_storeu_ps(out, _mm512_castps512_ps128(_mm512_permutexvar_ps(pick, x)));
}

}  // namespace GSB_ISA
}  // namespace gsb
