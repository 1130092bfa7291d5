// Colours of Gaussians, sixteen at a time; the mathematics is math/harmonics.h. What cannot be drawn costs nothing.
#include "../math/projection.h"
#include "../math/harmonics.h"

#include "isa.h"
#include "rows.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int64_t CHUNK = 512;
constexpr float TURN = 6.28318531f;

// What the colours of sixteen Gaussians are made of: everything but the coefficients.
struct Weights {
    Unit<Vec> unit;
    int used;  // harmonics
    Vec Y[MAX_BASIS], cosines[MAX_WAVES], sines[MAX_WAVES];

    GSB_HD Weights(const ColorArgs& a, int64_t i, int n) : unit(offset(a, i, n)) {
        used = harmonics(unit.direction, a.degree, Y);
        waves_of(a.times ? Vec(a.time) - load_first(a.times + i, n) : Vec(0.0f), a.waves, cosines, sines);
    }

    GSB_HD static Vec3<Vec> offset(const ColorArgs& a, int64_t i, int n) {
        Vec mean[3];
        gather_row(a.means, i, n, mean);
        return {mean[0] - a.center[0], mean[1] - a.center[1], mean[2] - a.center[2]};
    }
};

GSB_HD inline Mask drawn(const ColorArgs& a, int64_t i, int n) {
    return load_first(a.opacities + i, n) >= Vec(ALPHA_MIN);
}

// The arrays hold the coefficient of the constant apart from the others, three channels each.
struct Coefficients {
    int64_t stride;  // of shN, floats a Gaussian

    explicit Coefficients(const ColorArgs& a) : stride(static_cast<int64_t>(a.waves * a.bases - 1) * 3) {}

    template <class F>
    GSB_HD auto* at(F* sh0, F* shN, int64_t i, int k) const { return k ? shN + i * stride + (k - 1) * 3 : sh0 + i * 3; }
    GSB_HD int step(int k) const { return k ? static_cast<int>(stride) : 3; }
};

GSB_HD inline void sum_colors(const ColorArgs& a, const Coefficients& c, const Weights& w, int64_t i, int n,
                              Vec (&color)[3]) {
    for (auto& channel : color) channel = Vec(0.5f);
    for (int wave = 0; wave < a.waves; ++wave) {
        for (int basis = 0; basis < w.used; ++basis) {
            const int k = wave * a.bases + basis;
            const float* p = c.at(a.sh0, a.shN, i, k);
            const Vec weight = w.Y[basis] * w.cosines[wave];
            for (int channel = 0; channel < 3; ++channel) color[channel] += gather(p + channel, c.step(k), n) * weight;
        }
    }
}

GSB_HD inline void backward_block(const ColorArgs& a, const ColorGrads& out, int64_t i, int n, Mask shown) {
    const Coefficients c(a);
    const Weights w(a, i, n);
    const Vec zero(0.0f);
    Vec color[3], g[3], g_Y[MAX_BASIS];
    sum_colors(a, c, w, i, n, color);
    gather_row(out.colors, i, n, g);
    for (int k = 0; k < 3; ++k) g[k] = select(shown & (color[k] >= zero), g[k], zero);
    for (auto& y : g_Y) y = zero;
    Vec g_time(0.0f);
    for (int wave = 0; wave < a.waves; ++wave) {
        for (int basis = 0; basis < w.used; ++basis) {
            const int k = wave * a.bases + basis;
            const float* p = c.at(a.sh0, a.shN, i, k);
            float* g_p = c.at(out.sh0, out.shN, i, k);
            const Vec weight = w.Y[basis] * w.cosines[wave];
            Vec along(0.0f);
            for (int channel = 0; channel < 3; ++channel) {
                along += gather(p + channel, c.step(k), n) * g[channel];
                scatter(g[channel] * weight, g_p + channel, c.step(k), n);
            }
            g_Y[basis] += along * w.cosines[wave];
            g_time += along * w.Y[basis] * w.sines[wave] * (TURN * static_cast<float>(wave));  // by mu_t
        }
    }
    const Vec3<Vec> g_mean = w.unit.vjp(harmonics_vjp(w.unit.direction, a.degree, g_Y));
    const Vec rows[3] = {g_mean.x, g_mean.y, g_mean.z};
    scatter_row(rows, out.means, i, n);
    if (a.times) store_first(g_time, out.times + i, n);
}

}  // namespace

void show_colors(const ColorArgs& a, float* colors) {
    const Coefficients c(a);
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N > CHUNK)
    for (int64_t i = 0; i < a.N; i += LANES) {
        const int n = lanes_from(i, a.N);
        const Mask shown = drawn(a, i, n);
        Vec color[3] = {Vec(0.0f), Vec(0.0f), Vec(0.0f)};
        if (any(shown)) sum_colors(a, c, Weights(a, i, n), i, n, color);
        for (auto& channel : color) channel = select(shown, max(channel, Vec(0.0f)), Vec(0.0f));
        scatter_row(color, colors, i, n);
    }
}

void show_colors_backward(const ColorArgs& a, const ColorGrads& out) {
    const Coefficients c(a);
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N > CHUNK)
    for (int64_t i = 0; i < a.N; i += LANES) {
        const int n = lanes_from(i, a.N);
        const Mask shown = drawn(a, i, n);
        const bool some = any(shown);
        if (!some || (a.degree + 1) * (a.degree + 1) < a.bases) {  // coefficients that the block leaves untouched
            __builtin_memset(out.shN + i * c.stride, 0, sizeof(float) * static_cast<size_t>(n * c.stride));
        }
        if (some) {
            backward_block(a, out, i, n, shown);
            continue;
        }
        __builtin_memset(out.sh0 + i * 3, 0, sizeof(float) * static_cast<size_t>(n) * 3);
        __builtin_memset(out.means + i * 3, 0, sizeof(float) * static_cast<size_t>(n) * 3);
        if (a.times) __builtin_memset(out.times + i, 0, sizeof(float) * static_cast<size_t>(n));
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
