// Colours of Gaussians, sixteen at a time; the mathematics is math/harmonics.h. What cannot be drawn costs nothing.
//
// A 4D Gaussian has 144 coefficients and is drawn for part of the time, so memory is what counts here: those with
// something to do are packed first, and the rows of all others are neither read nor worked on. Where rows have orders,
// the packed are sorted by order: a vector is of one, and no coefficient above it is read.
#include "../math/projection.h"
#include "../math/harmonics.h"

#include "isa.h"
#include "rows.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int64_t CHUNK = 512;  // Gaussians a task
constexpr float TURN = 6.28318531f;

// The numbers, within a chunk, of those of its Gaussians that have something to do.
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

// Sixteen picked rows, or what is left of them; lanes without one read zero.
struct Rows {
    int count;
    alignas(64) int32_t ones[LANES] = {}, threes[LANES] = {}, all[LANES] = {};

    GSB_HD Rows(const uint32_t* which, int count, int stride) : count(count) {
        for (int k = 0; k < count; ++k) {
            ones[k] = static_cast<int32_t>(which[k]);
            threes[k] = ones[k] * 3;
            all[k] = ones[k] * stride;
        }
    }
    GSB_HD Vec load(const float* p, const int32_t (&offsets)[LANES]) const { return gather_rows(p, offsets, count); }
    GSB_HD void store(Vec x, float* p, const int32_t (&offsets)[LANES]) const { scatter_rows(x, p, offsets, count); }
    GSB_HD void load3(const float* p, Vec (&out)[3]) const {
        for (int k = 0; k < 3; ++k) out[k] = load(p + k, threes);
    }
    GSB_HD void add3(const Vec (&x)[3], float* p) const {
        for (int k = 0; k < 3; ++k) store(load(p + k, threes) + x[k], p + k, threes);
    }
    GSB_HD void store3(const Vec (&x)[3], float* p) const {
        for (int k = 0; k < 3; ++k) store(x[k], p + k, threes);
    }
};

// `width` columns of picked rows, one after the other. A column's floats are far apart, a row's are not: sixteen columns
// are read as pieces of rows, and turned.
class ColumnsIn {
public:
    GSB_HD ColumnsIn(const float* p, const int32_t (&offsets)[LANES], int count, int width)
        : p(p), offsets(offsets), count(count), left(width) {}

    GSB_HD Vec next() {
        if (at == LANES) fill();
        return block[at++];
    }

private:
    GSB_HD void fill() {
        const int n = left < LANES ? left : LANES;
        for (int i = 0; i < count; ++i) __builtin_prefetch(p + offsets[i] + 2 * LANES);  // far apart, so nothing else would
        for (int i = 0; i < LANES; ++i) block[i] = i < count ? load_some(p + offsets[i], n) : Vec(0.0f);
        transpose(block);
        p += n;
        left -= n;
        at = 0;
    }

    const float* p;
    const int32_t (&offsets)[LANES];
    int count, left, at = LANES;
    Vec block[LANES];
};

// The same, to be added to; `flush` at the end.
class ColumnsOut {
public:
    GSB_HD ColumnsOut(float* p, const int32_t (&offsets)[LANES], int count) : p(p), offsets(offsets), count(count) {
        for (auto& column : block) column = Vec(0.0f);
    }

    GSB_HD void put(Vec x) {
        block[at++] = x;
        if (at == LANES) flush();
    }
    // Goes on at another column.
    GSB_HD void move_to(float* to) {
        flush();
        p = to;
    }
    GSB_HD void flush() {
        if (at == 0) return;
        transpose(block);
        for (int i = 0; i < count; ++i) store_first(load_some(p + offsets[i], at) + block[i], p + offsets[i], at);
        p += at;
        at = 0;
    }

private:
    float* p;
    const int32_t (&offsets)[LANES];
    int count, at = 0;
    Vec block[LANES];
};

// What the colours of sixteen Gaussians are made of.
struct Shades {
    Unit<Vec> unit;
    int used;  // harmonics
    Vec Y[MAX_BASIS], cosines[MAX_WAVES], sines[MAX_WAVES];

    GSB_HD Shades(const ColorArgs& a, const Rows& rows) : unit(offset(a, rows)) {
        used = harmonics(unit.direction, a.degree, Y);
        waves_of(a.times ? Vec(*a.time) - rows.load(a.times, rows.ones) : Vec(0.0f), a.waves, cosines, sines);
    }

    // Where a wave's coefficients begin in a row of shN, and how many floats of them are used. The constant's are kept in
    // an array of their own, sh0.
    GSB_HD static int begin(const ColorArgs& a, int wave) { return wave ? (wave * a.bases - 1) * 3 : 0; }
    GSB_HD int width(int wave) const { return (used - (wave == 0)) * 3; }

    // Calls f(wave, basis, coefficients of the three channels) for every basis that is used.
    template <class F>
    GSB_HD void each(const ColorArgs& a, const Rows& rows, F f) const {
        for (int wave = 0; wave < a.waves; ++wave) {
            ColumnsIn columns(a.shN + begin(a, wave), rows.all, rows.count, width(wave));
            for (int basis = 0; basis < used; ++basis) {
                Vec c[3];
                if (wave == 0 && basis == 0) {
                    rows.load3(a.sh0, c);
                } else {
                    for (auto& channel : c) channel = columns.next();
                }
                f(wave, basis, c);
            }
        }
    }

    // Before they are clamped.
    GSB_HD void sum(const ColorArgs& a, const Rows& rows, Vec (&color)[3]) const {
        for (auto& channel : color) channel = Vec(0.5f);
        each(a, rows, [&](int wave, int basis, const Vec (&c)[3]) {
            const Vec weight = Y[basis] * cosines[wave];
            for (int channel = 0; channel < 3; ++channel) color[channel] += c[channel] * weight;
        });
    }

    GSB_HD static Vec3<Vec> offset(const ColorArgs& a, const Rows& rows) {
        Vec mean[3];
        rows.load3(a.means, mean);
        return {mean[0] - a.center[0], mean[1] - a.center[1], mean[2] - a.center[2]};
    }
};

GSB_HD inline int stride_of(const ColorArgs& a) { return (a.waves * a.bases - 1) * 3; }

// The same Gaussians' arguments, from the one at `first` on, as many as a task has.
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

// Where the rows of each order begin among those picked, once they are sorted by order.
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

// Calls f(arguments, picked) for the rows of each order, whose arguments have its degree and waves.
template <class F>
GSB_HD inline void each_order(const ColorArgs& a, Picked& picked, F f) {
    const Sorted sorted(a, picked);
    for (int order = 0; order < Sorted::ORDERS; ++order) {
        const int begin = sorted.begin[order], count = sorted.begin[order + 1] - begin;
        if (count > 0) f(at_order(a, ColorOrder::of(static_cast<uint32_t>(order))), picked.which + begin, count);
    }
}

// Not inlined: what the compiler then knows of an order's range would change what it rounds.
__attribute__((noinline)) void show_rows(const ColorArgs& a, const uint32_t* which, int count, int stride, float* out) {
    for (int k = 0; k < count; k += LANES) {
        const Rows rows(which + k, lanes_from(k, count), stride);
        Vec color[3];
        Shades(a, rows).sum(a, rows, color);
        for (auto& channel : color) channel = max(channel, Vec(0.0f));
        rows.store3(color, out);
    }
}

GSB_HD inline void backward_rows(const ColorArgs& a, const float* g_colors, const ColorGrads& out, const Rows& rows) {
    const Vec zero(0.0f);
    Vec color[3], g[3], g_Y[MAX_BASIS], g_time(0.0f);
    const Shades s(a, rows);
    s.sum(a, rows, color);
    rows.load3(g_colors, g);
    for (int k = 0; k < 3; ++k) g[k] = select(color[k] >= zero, g[k], zero);
    for (auto& y : g_Y) y = zero;
    ColumnsOut columns(out.shN, rows.all, rows.count);
    s.each(a, rows, [&](int wave, int basis, const Vec (&c)[3]) {
        if (basis == 0) columns.move_to(out.shN + Shades::begin(a, wave));
        const Vec weight = s.Y[basis] * s.cosines[wave];
        Vec along(0.0f), g_c[3];
        for (int channel = 0; channel < 3; ++channel) {
            along += c[channel] * g[channel];
            g_c[channel] = g[channel] * weight;
        }
        if (wave == 0 && basis == 0) {
            rows.add3(g_c, out.sh0);
        } else {
            for (const auto& channel : g_c) columns.put(channel);
        }
        g_Y[basis] += along * s.cosines[wave];
        g_time += along * s.Y[basis] * s.sines[wave] * (TURN * static_cast<float>(wave));  // by mu_t
    });
    columns.flush();
    const Vec3<Vec> g_mean = s.unit.vjp(harmonics_vjp(s.unit.direction, a.degree, g_Y));
    rows.store3({g_mean.x, g_mean.y, g_mean.z}, out.means);
    if (a.times) rows.store(g_time, out.times, rows.ones);
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

void show_colors_backward(const ColorArgs& all, const GivenColors& given, const ColorGrads& grads) {
#pragma omp parallel for num_threads(all.threads) schedule(static) if (all.N > CHUNK)
    for (int64_t first = 0; first < all.N; first += CHUNK) {
        const ColorArgs a = chunk_of(all, first);
        const ColorGrads out = chunk_of(grads, all, first);
        const float* g_colors = given.colors + first * 3;
        const int size = static_cast<int>(a.N);
        Picked picked(size, [&](int i, int n) { return learns(a, g_colors, i, n); });
        picked.each_gap(size, [&](int from, int end) {
            fill_zero(out.means, 3, from, end);
            if (a.times) fill_zero(out.times, 1, from, end);
        });
        each_order(a, picked, [&](const ColorArgs& own, const uint32_t* which, int count) {
            for (int k = 0; k < count; k += LANES) {
                backward_rows(own, g_colors, out, Rows(which + k, lanes_from(k, count), stride_of(a)));
            }
        });
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
