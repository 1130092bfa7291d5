// Moves floats between memory and the lanes of a SIMD vector of two AVX registers (AVX2).
//
// Loops over lanes would store floats one by one and load them as a vector; such a load has to wait for all the stores.
// So rows become columns by shuffles of four floats at a time.
#pragma once

#include <cstdint>

#include <immintrin.h>

namespace gsb {
inline namespace GSB_ISA {

// Loads the floats at(0) .. at(15) one by one; `vgatherdps` takes as long, or longer.
template <class At>
GSB_HD inline Vec collect(At at) {
    const auto half = [&](int i) {
        const __m128 low = _mm_setr_ps(at(i), at(i + 1), at(i + 2), at(i + 3));
        return Register(Floats(_mm256_set_m128(_mm_setr_ps(at(i + 4), at(i + 5), at(i + 6), at(i + 7)), low)));
    };
    return {half(0), half(WIDTH)};
}

// Loads p[lane * stride] to the first n lanes, and zero to the others; `scatter` stores them.
GSB_HD inline Vec gather(const float* p, int stride, int n = LANES) {
    if (n == LANES) return collect([&](int i) { return p[i * stride]; });
    return collect([&](int i) { return i < n ? p[i * stride] : 0.0f; });
}
GSB_HD inline void scatter(Vec x, float* p, int stride, int n = LANES) {
    alignas(64) float lane[LANES];
    x.store(lane);
    for (int i = 0; i < n; ++i) p[i * stride] = lane[i];
}

// Loads p[offsets[lane]] to the first n lanes, and zero to the others; `scatter_rows` stores them.
GSB_HD inline Vec gather_rows(const float* p, const int32_t* offsets, int n) {
    if (n == LANES) return collect([&](int i) { return p[offsets[i]]; });
    return collect([&](int i) { return i < n ? p[offsets[i]] : 0.0f; });
}

// Loads the first n floats of p, and zero to the other lanes; `store_first` stores them.
GSB_HD inline Vec load_some(const float* p, int n) {
    if (n == LANES) return Vec::load(p);
    alignas(32) static constexpr int32_t set[2 * LANES] = {-1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1};
    const auto half = [&](int from) {
        const auto* mask = reinterpret_cast<const __m256i*>(set + LANES - n + from);
        return Register(Floats(_mm256_maskload_ps(p + from, _mm256_loadu_si256(mask))));
    };
    return {half(0), half(WIDTH)};
}

// A masked store takes tens of operations of an AMD processor.
GSB_HD inline void store_first(Vec x, float* p, int n) {
    if (n == LANES) return x.store(p);
    __m256 rest = x.lo.v;
    if (n & 8) {
        x.lo.store(p);
        p += 8;
        rest = x.hi.v;
    }
    __m128 four = _mm256_castps256_ps128(rest);
    if (n & 4) {
        _mm_storeu_ps(p, four);
        p += 4;
        four = _mm256_extractf128_ps(rest, 1);
    }
    if (n & 2) {
        _mm_storel_pi(reinterpret_cast<__m64*>(p), four);
        p += 2;
        four = _mm_movehl_ps(four, four);
    }
    if (n & 1) _mm_store_ss(p, four);
}

// Transposes four rows of four floats in each half of the registers.
GSB_HD inline void transpose4(__m256 (&x)[4]) {
    const __m256 a = _mm256_unpacklo_ps(x[0], x[1]), b = _mm256_unpackhi_ps(x[0], x[1]);
    const __m256 c = _mm256_unpacklo_ps(x[2], x[3]), d = _mm256_unpackhi_ps(x[2], x[3]);
    x[0] = _mm256_shuffle_ps(a, c, 0x44);
    x[1] = _mm256_shuffle_ps(a, c, 0xee);
    x[2] = _mm256_shuffle_ps(b, d, 0x44);
    x[3] = _mm256_shuffle_ps(b, d, 0xee);
}

// Loads four columns of eight rows of W floats. Of the last row, the four floats that begin `before` floats earlier are
// read and turned, so that nothing is read past its end if the columns are the last 4 - `before`.
template <int W, int before = 0>
GSB_HD inline void load_four(const float* p, __m256 (&out)[4]) {
    __m128 last = _mm_loadu_ps(p + 7 * W - before);
    if constexpr (before > 0) last = _mm_permute_ps(last, before == 1 ? 0x39 : 0x4e);
    for (int k = 0; k < 4; ++k) {
        const __m128 high = k < 3 ? _mm_loadu_ps(p + (k + 4) * W) : last;
        out[k] = _mm256_set_m128(high, _mm_loadu_ps(p + k * W));
    }
    transpose4(out);
}

// Columns of rows of W floats are moved in windows of four; the last window is moved back, so that it ends with the row.
template <int W>
GSB_HD constexpr int window_start(int window) {
    return W < 4 || 4 * window + 4 <= W ? 4 * window : W - 4;
}

// Loads sixteen adjacent rows of W floats as W columns; `store_columns` stores them.
template <int W>
GSB_HD inline void load_columns(const float* p, Vec (&out)[W]) {
    if constexpr (W == 1) {
        out[0] = Vec::load(p);
    } else {
        for (int window = 0; 4 * window < W; ++window) {
            const int first = window_start<W>(window);
            __m256 low[4], high[4];
            load_four<W>(p + first, low);
            load_four<W, (W < 4 ? 4 - W : 0)>(p + first + 8 * W, high);
            for (int k = 0; k < (W < 4 ? W : 4); ++k) out[first + k] = {Floats(low[k]), Floats(high[k])};
        }
    }
}
template <int W>
GSB_HD inline void store_columns(const Vec (&x)[W], float* p) {
    if constexpr (W == 1) {
        x[0].store(p);
    } else {
        for (int half = 0; half < 2; ++half) {
            float* rows = p + 8 * half * W;
            for (int window = 0; 4 * window < W; ++window) {
                const int first = window_start<W>(window);
                __m256 row[4];
                for (int k = 0; k < 4; ++k) {
                    const Vec& column = x[first + k < W ? first + k : W - 1];
                    row[k] = half ? column.hi.v : column.lo.v;
                }
                transpose4(row);
                // If a row has fewer than four floats, the others are overwritten by the next row, which is stored later.
                for (int k = 0; k < 4; ++k) _mm_storeu_ps(rows + k * W + first, _mm256_castps256_ps128(row[k]));
                for (int k = 0; k < 3; ++k) _mm_storeu_ps(rows + (k + 4) * W + first, _mm256_extractf128_ps(row[k], 1));
                const __m128 last = _mm256_extractf128_ps(row[3], 1);
                if constexpr (W >= 4) {
                    _mm_storeu_ps(rows + 7 * W + first, last);
                } else {
                    _mm_storel_pi(reinterpret_cast<__m64*>(rows + 7 * W), last);
                    if constexpr (W == 3) _mm_store_ss(rows + 7 * W + 2, _mm_movehl_ps(last, last));
                }
            }
        }
    }
}

// Transposes sixteen rows of sixteen floats.
GSB_HD inline void transpose(Vec (&x)[LANES]) {
    alignas(64) float rows[LANES * LANES];
    for (int i = 0; i < LANES; ++i) x[i].store(rows + i * LANES);
    load_columns(rows, x);
}

// Returns the vector whose lane i is lane from[i] of x.
GSB_HD inline Vec permute(Vec x, const int32_t* from) {
    const auto half = [&](const int32_t* p) {
        const __m256i at = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(p));
        const __m256 low = _mm256_permutevar8x32_ps(x.lo.v, at), high = _mm256_permutevar8x32_ps(x.hi.v, at);
        return Register(Floats(_mm256_blendv_ps(low, high, _mm256_castsi256_ps(_mm256_slli_epi32(at, 28)))));
    };
    return {half(from), half(from + WIDTH)};
}

// Returns y[start + i / 3] in lane i < 15; of the last lane only that it comes from y[start + 5]. `at` has these indices.
GSB_HD inline Vec spread(const float* y, int start, const int32_t*) {
    const __m256 low = _mm256_broadcast_ps(reinterpret_cast<const __m128*>(y + start));
    const __m256 high = _mm256_broadcast_ps(reinterpret_cast<const __m128*>(y + start + 2));
    return {Floats(_mm256_permutevar_ps(low, _mm256_setr_epi32(0, 0, 0, 1, 1, 1, 2, 2))),
            Floats(_mm256_permutevar_ps(high, _mm256_setr_epi32(0, 1, 1, 1, 2, 2, 2, 3)))};
}

// Returns x[j] + x[j + 1] + x[j + 2] in lane i, where j = at[i] is 0, 3, 6, 9 or 12. Modulo 8 these are different, so
// that one register holds all of them.
GSB_HD inline Vec sum_threes(Vec x, const int32_t* at) {
    const __m256 first = _mm256_blend_ps(x.lo.v, x.hi.v, 0x12);                 // x[0], x[9], -, x[3], x[12], -, x[6], -
    const __m256 second = _mm256_blend_ps(x.lo.v, x.hi.v, 0x24);                // -, x[1], x[10], -, x[4], x[13], -, x[7]
    const __m256 third = _mm256_blend_ps(x.lo.v, x.hi.v, 0x49);                 // x[8], -, x[2], x[11], -, x[5], x[14], -
    const __m256 next = _mm256_permutevar8x32_ps(second, _mm256_setr_epi32(1, 2, 3, 4, 5, 6, 7, 0));
    const __m256 after = _mm256_permutevar8x32_ps(third, _mm256_setr_epi32(2, 3, 4, 5, 6, 7, 0, 1));
    const __m256 sum = _mm256_add_ps(_mm256_add_ps(first, next), after);
    const auto half = [&](const int32_t* p) {
        return Register(Floats(_mm256_permutevar8x32_ps(sum, _mm256_loadu_si256(reinterpret_cast<const __m256i*>(p)))));
    };
    return {half(at), half(at + WIDTH)};
}

}  // namespace GSB_ISA
}  // namespace gsb
