// Colours of Gaussians, sixteen at a time; math/harmonics.h has the formulas. Gaussians with an opacity below 1/255 are
// skipped.
//
// A 4DGS Gaussian has 144 coefficients and is visible for part of the time, so the speed depends on memory: the
// Gaussians that need a colour are packed first, and the rows of the others are not read. If Gaussians have different
// orders (SH degree and number of frequencies), they are sorted by order, so that a vector has one order and no
// coefficient above it is read.
#include "../math/projection.h"
#include "../math/harmonics.h"

#include "isa.h"
#include "rows.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int64_t CHUNK = 512;  // Gaussians a task
constexpr float TURN = 6.28318531f;

// The indices, within a chunk, of the Gaussians that need a colour or a gradient.
struct Picked {
    int count = 0;
    uint32_t which[CHUNK + LANES];  // append_bits writes up to a vector past the end

    template <class Wanted>
    GSB_HD Picked(int size, Wanted wanted) {
        for (int i = 0; i < size; i += LANES) {
            count += append_bits(bits(wanted(i, lanes_from(i, size))), static_cast<uint32_t>(i), which + count);
        }
    }

    // Calls f(first, end) for each run of Gaussians that were not picked.
    template <class F>
    GSB_HD void each_gap(int size, F f) const {
        int next = 0;
        for (int k = 0; k < count; ++k) {
            const int row = static_cast<int>(which[k]);
            if (row > next) f(next, row);
            next = row + 1;
        }
        if (size > next) f(next, size);
    }
};

// Sixteen picked rows, or the remaining ones; lanes without a row read zero.
struct Rows {
    const uint32_t* which;
    int left, count, stride;  // left: these rows and those that are picked after them
    alignas(64) int32_t ones[LANES] = {}, threes[LANES] = {}, all[LANES] = {};

    GSB_HD Rows(const uint32_t* which, int left, int stride)
        : which(which), left(left), count(left < LANES ? left : LANES), stride(stride) {
        for (int k = 0; k < count; ++k) {
            ones[k] = static_cast<int32_t>(which[k]);
            threes[k] = ones[k] * 3;
            all[k] = ones[k] * stride;
        }
    }
    // Prefetches the first floats of the row sixteen rows further on. Only long adjacent rows does the processor itself
    // fetch in time; picked rows need not be adjacent.
    template <bool WRITE>
    GSB_HD void prefetch(const float* p, int width, int i) const {
        if (!width || i + LANES >= left) return;
        if (width > 4 * LANES && which[i + LANES] == which[i + LANES - 1] + 1) return;
        const float* row = p + static_cast<int64_t>(which[i + LANES]) * stride;
        for (int k = 0; k < width; k += LANES) __builtin_prefetch(row + k, WRITE);
        __builtin_prefetch(row + width - 1, WRITE);
    }
    GSB_HD Vec load(const float* p, const int32_t (&offsets)[LANES]) const { return gather_rows(p, offsets, count); }
    GSB_HD void store(Vec x, float* p, const int32_t (&offsets)[LANES]) const { scatter_rows(x, p, offsets, count); }
    GSB_HD void load3(const float* p, Vec (&out)[3]) const {
        for (int k = 0; k < 3; ++k) out[k] = load(p + k, threes);
    }
    GSB_HD void store3(const Vec (&x)[3], float* p) const {
        for (int k = 0; k < 3; ++k) store(x[k], p + k, threes);
    }
};

// A row of shN is read in pieces as it is stored: up to five coefficients of one frequency, with three channels each.
// So the channel of a lane is its index modulo three in every piece, and only sums and weights have to be transposed.
constexpr int PIECE_BASES = 5;

struct Piece {
    int at, floats, wave;           // where in the row it begins, and how many floats it has
    int basis;                      // its first
    alignas(64) int32_t spread[LANES];   // each lane's basis
    alignas(64) int32_t bases_at[LANES]; // for a lane that is a basis of this piece, where its first channel lies
    Mask bases;                     // these lanes
};

struct Pieces {
    int count = 0, width = 0;  // width: floats of a row up to the last of them
    const float* end;          // of all rows
    Piece piece[MAX_WAVES * ((MAX_BASIS + PIECE_BASES - 1) / PIECE_BASES)];

    // The constant coefficients are stored in a separate array, sh0.
    GSB_HD Pieces(const ColorArgs& a, int stride) : end(a.shN + a.N * stride) {
        const int used = (a.degree + 1) * (a.degree + 1);
        for (int wave = 0; wave < a.waves; ++wave) {
            for (int basis = wave == 0; basis < used; basis += PIECE_BASES) {
                const int n = used - basis < PIECE_BASES ? used - basis : PIECE_BASES;
                Piece& p = piece[count++];
                p.at = (wave * a.bases - 1 + basis) * 3;
                p.floats = n * 3;
                p.wave = wave;
                p.basis = basis;
                width = p.at + p.floats;
                for (int i = 0; i < LANES; ++i) {
                    p.spread[i] = basis + i / 3 < LANES ? basis + i / 3 : LANES - 1;
                    p.bases_at[i] = i >= basis && i < basis + n ? (i - basis) * 3 : 0;
                }
                const Vec lane = Vec::load(INDEX);
                p.bases = (lane >= Vec(static_cast<float>(basis))) & (lane < Vec(static_cast<float>(basis + n)));
            }
        }
    }

    // Loads the coefficients of a piece of a row. The last lane of a full piece is not used, so no mask is needed except
    // at the end of all rows; with AVX2 a masked load takes longer.
    GSB_HD Vec load(const float* row, const Piece& p) const {
        row += p.at;
        return p.floats == 3 * PIECE_BASES && row + LANES <= end ? Vec::load(row) : load_some(row, p.floats);
    }
};

alignas(64) constexpr int32_t CHANNELS[LANES] = {0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 3};  // lane 3 is zero

// Everything that the colours of sixteen Gaussians need except coefficients.
struct Shades {
    Unit<Vec> unit;
    alignas(64) float Y[LANES + 1][LANES];                          // a Gaussian's harmonics in each row; `spread` reads on
    alignas(64) float cosines[MAX_WAVES][LANES], sines[MAX_WAVES][LANES];

    GSB_HD Shades(const ColorArgs& a, const Rows& rows) : unit(offset(a, rows)) {
        static_assert(MAX_BASIS == LANES);
        Vec y[LANES];
        for (auto& basis : y) basis = Vec(0.0f);
        harmonics(unit.direction, a.degree, y);
        transpose(y);
        for (int i = 0; i < LANES; ++i) y[i].store(Y[i]);
        Vec(0.0f).store(Y[LANES]);
        Vec cosine[MAX_WAVES], sine[MAX_WAVES];
        waves_of(a.times ? Vec(*a.time) - rows.load(a.times, rows.ones) : Vec(0.0f), a.waves, cosine, sine);
        for (int wave = 0; wave < a.waves; ++wave) {
            cosine[wave].store(cosines[wave]);
            sine[wave].store(sines[wave]);
        }
    }

    // Returns the weight of each coefficient of a piece of row i.
    GSB_HD Vec weight(int i, const Piece& p) const {
        const Vec y = spread(Y[i], p.basis, p.spread);
        return p.wave ? y * Vec(cosines[p.wave][i]) : y;
    }

    // Computes the colour channels before they are clamped.
    GSB_HD void sum(const ColorArgs& a, const Pieces& pieces, const Rows& rows, Vec (&color)[3]) const {
        Vec sums[LANES];
        for (int i = 0; i < rows.count; ++i) {
            const float* row = a.shN + rows.all[i];
            rows.prefetch<false>(a.shN, pieces.width, i);
            Vec total(0.0f);
            for (int k = 0; k < pieces.count; ++k) {
                const Piece& p = pieces.piece[k];
                total += pieces.load(row, p) * weight(i, p);
            }
            sums[i] = total;
        }
        for (int i = rows.count; i < LANES; ++i) sums[i] = Vec(0.0f);
        transpose(sums);
        rows.load3(a.sh0, color);
        for (int c = 0; c < 3; ++c) {
            color[c] = color[c] * SH_0 + 0.5f + (sums[c] + sums[c + 3] + (sums[c + 6] + sums[c + 9]) + sums[c + 12]);
        }
    }

    GSB_HD static Vec3<Vec> offset(const ColorArgs& a, const Rows& rows) {
        Vec mean[3];
        rows.load3(a.means, mean);
        return {mean[0] - a.center[0], mean[1] - a.center[1], mean[2] - a.center[2]};
    }
};

GSB_HD inline int stride_of(const ColorArgs& a) { return (a.waves * a.bases - 1) * 3; }

// Returns the arguments of one task: CHUNK Gaussians from `first` on, or those that remain.
GSB_HD inline ColorArgs chunk_of(ColorArgs a, int64_t first) {
    a.N = a.N - first < CHUNK ? a.N - first : CHUNK;
    a.sh0 += first * 3;
    a.shN += first * stride_of(a);
    a.means += first * 3;
    a.opacities += first;
    if (a.times) a.times += first;
    if (a.orders) a.orders += first;
    return a;
}
GSB_HD inline ColorGrads chunk_of(ColorGrads g, const ColorArgs& a, int64_t first) {
    g.sh0 += first * 3;
    g.shN += first * stride_of(a);
    g.means += first * 3;
    if (a.times) g.times += first;
    return g;
}

GSB_HD inline Mask drawn(const ColorArgs& a, int i, int n) { return load_first(a.opacities + i, n) >= Vec(ALPHA_MIN); }

GSB_HD inline Mask learns(const ColorArgs& a, const float* g_colors, int i, int n) {
    Vec color[3];
    gather_row(g_colors, i, n, color);
    return drawn(a, i, n) & !((color[0] == Vec(0.0f)) & (color[1] == Vec(0.0f)) & (color[2] == Vec(0.0f)));
}

GSB_HD inline ColorArgs at_order(ColorArgs a, ColorOrder order) {
    a.degree = order.degree;
    a.waves = order.waves;
    return a;
}

// The picked rows sorted by order (SH degree and number of frequencies), and the first row of each order.
struct Sorted {
    static constexpr int ORDERS = 4 * MAX_WAVES;
    int begin[ORDERS + 1] = {};

    GSB_HD Sorted(const ColorArgs& a, Picked& picked) {
        const ColorOrder most{a.degree, a.waves};
        uint8_t order[CHUNK];
        int first = most.number(), other = 0;  // other: not zero where some order is not the first row's
        if (a.orders) {
            for (int i = 0; i < a.N; ++i) order[i] = static_cast<uint8_t>(order_of(a.orders[i], most));
            first = order[0];
            for (int i = 0; i < a.N; ++i) other |= order[i] ^ first;
        }
        if (!other) {
            for (int l = first; l < ORDERS; ++l) begin[l + 1] = picked.count;
            return;
        }
        int next[ORDERS] = {};
        for (int k = 0; k < picked.count; ++k) ++next[order[picked.which[k]]];
        for (int l = 0; l < ORDERS; ++l) {
            begin[l + 1] = begin[l] + next[l];
            next[l] = begin[l];
        }
        uint32_t before[CHUNK];
        __builtin_memcpy(before, picked.which, sizeof(before));
        for (int k = 0; k < picked.count; ++k) picked.which[next[order[before[k]]]++] = before[k];
    }

    GSB_HD static int order_of(int32_t own, ColorOrder most) {
        return ColorOrder::of(static_cast<uint32_t>(own)).at_most(most).number();
    }
};

// Calls f(arguments, picked) for the rows of each order; the arguments have the degree and frequencies of this order.
template <class F>
GSB_HD inline void each_order(const ColorArgs& a, Picked& picked, F f) {
    const Sorted sorted(a, picked);
    for (int order = 0; order < Sorted::ORDERS; ++order) {
        const int begin = sorted.begin[order], count = sorted.begin[order + 1] - begin;
        if (count > 0) f(at_order(a, ColorOrder::of(static_cast<uint32_t>(order))), picked.which + begin, count);
    }
}

// Not inlined: otherwise the compiler would use the known range of the order, which changes the rounding.
__attribute__((noinline)) void show_rows(const ColorArgs& a, const uint32_t* which, int count, int stride, float* out) {
    const Pieces pieces(a, stride);
    for (int k = 0; k < count; k += LANES) {
        const Rows rows(which + k, count - k, stride);
        Vec color[3];
        Shades(a, rows).sum(a, pieces, rows, color);
        for (auto& channel : color) channel = select(channel >= Vec(0.0f), channel, Vec(CLAMPED));
        rows.store3(color, out);
    }
}

GSB_HD inline void backward_rows(const ColorArgs& a, const Pieces& pieces, const float* colors, const float* g_colors,
                                 const ColorGrads& out, const Rows& rows) {
    const Vec zero(0.0f);
    const Shades s(a, rows);
    Vec g_Y[LANES], g_time[LANES];  // of a Gaussian in each vector
    for (int i = 0; i < rows.count; ++i) {
        const Vec color = load_some(colors + rows.threes[i], 3);
        Vec g = load_some(g_colors + rows.threes[i], 3);
        g = select(Vec(1.0f) / color > zero, g, zero);  // 1 / -0 is -inf
        add_first(g * SH_0, out.sh0 + rows.threes[i], 3);
        g = permute(g, CHANNELS);
        const float* row = a.shN + rows.all[i];
        float* g_row = out.shN + rows.all[i];
        rows.prefetch<false>(a.shN, pieces.width, i);
        rows.prefetch<true>(out.shN, pieces.width, i);
        g_Y[i] = g_time[i] = zero;
        for (int k = 0; k < pieces.count; ++k) {
            const Piece& p = pieces.piece[k];
            add_first(s.weight(i, p) * g, g_row + p.at, p.floats);
            const Vec product = pieces.load(row, p) * g;
            const Vec along = select(p.bases, sum_threes(product, p.bases_at), zero);
            g_Y[i] += p.wave ? along * Vec(s.cosines[p.wave][i]) : along;
            if (p.wave) g_time[i] += along * Vec::load(s.Y[i]) * (s.sines[p.wave][i] * (TURN * static_cast<float>(p.wave)));
        }
    }
    for (int i = rows.count; i < LANES; ++i) g_Y[i] = g_time[i] = zero;
    transpose(g_Y);
    const Vec3<Vec> g_mean = s.unit.vjp(harmonics_vjp(s.unit.direction, a.degree, g_Y));
    rows.store3({g_mean.x, g_mean.y, g_mean.z}, out.means);
    if (!a.times) return;
    transpose(g_time);
    Vec total = g_time[0];  // by mu_t
    for (int k = 1; k < LANES; ++k) total += g_time[k];
    rows.store(total, out.times, rows.ones);
}

}  // namespace

void show_colors(const ColorArgs& all, const Colors& shown) {
#pragma omp parallel for num_threads(all.threads) schedule(static) if (all.N > CHUNK)
    for (int64_t first = 0; first < all.N; first += CHUNK) {
        const ColorArgs a = chunk_of(all, first);
        const int size = static_cast<int>(a.N);
        float* out = shown.colors + first * 3;
        Picked picked(size, [&](int i, int n) { return drawn(a, i, n); });
        picked.each_gap(size, [&](int from, int end) { fill_zero(out, 3, from, end); });
        each_order(a, picked, [&](const ColorArgs& own, const uint32_t* which, int count) {
            show_rows(own, which, count, stride_of(a), out);
        });
    }
}

void show_colors_backward(const ColorArgs& all, const ShownColors& shown, const GivenColors& given,
                          const ColorGrads& grads) {
#pragma omp parallel for num_threads(all.threads) schedule(static) if (all.N > CHUNK)
    for (int64_t first = 0; first < all.N; first += CHUNK) {
        const ColorArgs a = chunk_of(all, first);
        const ColorGrads out = chunk_of(grads, all, first);
        const float *colors = shown.colors + first * 3, *g_colors = given.colors + first * 3;
        const int size = static_cast<int>(a.N);
        Picked picked(size, [&](int i, int n) { return learns(a, g_colors, i, n); });
        picked.each_gap(size, [&](int from, int end) {
            fill_zero(out.means, 3, from, end);
            if (a.times) fill_zero(out.times, 1, from, end);
        });
        each_order(a, picked, [&](const ColorArgs& own, const uint32_t* which, int count) {
            const Pieces pieces(own, stride_of(a));
            for (int k = 0; k < count; k += LANES) {
                backward_rows(own, pieces, colors, g_colors, out, Rows(which + k, count - k, stride_of(a)));
            }
        });
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
