// Colours of Gaussians and their gradients for all views, one Gaussian per thread; math/harmonics.h has the formulas.
// Gaussians with an opacity below 1/255 are skipped.
#include "../math/harmonics.h"

#include "launch.h"

namespace gsb::cuda {
namespace {

constexpr float TURN = 6.28318531f;

// A Gaussian as one view sees it: the rows of its mean and opacity, of its mean time, and of its colour.
struct Seen {
    int64_t view, gaussian, time, color;

    __device__ Seen(const ColorArgs& a, int64_t view, int64_t i)
        : view(view),
          gaussian(a.gaussian_per_view ? view * a.N + i : i),
          time(a.time_per_view ? view * a.N + i : i),
          color(view * a.N + i) {}
};

// Everything that a colour needs except its coefficients.
struct Weights {
    Unit<float> unit;
    int used;  // harmonics
    float Y[MAX_BASIS], cosines[MAX_WAVES], sines[MAX_WAVES];

    __device__ Weights(const ColorArgs& a, ColorOrder order, const Seen& at)
        : unit(offset(a.means + at.gaussian * 3, a.center + at.view * 3)) {
        used = harmonics(unit.direction, order.degree, Y);
        waves_of(a.times ? a.time[at.view] - a.times[at.time] : 0.0f, order.waves, cosines, sines);
    }
    __device__ static Vec3<float> offset(const float* mean, const float* center) {
        return {mean[0] - center[0], mean[1] - center[1], mean[2] - center[2]};
    }
};

// Returns the SH degree and the number of frequencies of a Gaussian.
__device__ ColorOrder order_of(const ColorArgs& a, int64_t i) {
    const ColorOrder all{a.degree, a.waves};
    return a.orders ? ColorOrder::of(static_cast<uint32_t>(a.orders[i])).at_most(all) : all;
}

// Returns the address of coefficient k (three channels) of Gaussian i; the constant one is in an array of its own.
template <class F>
__device__ F* coefficient(const ColorArgs& a, F* sh0, F* shN, int64_t i, int k) {
    return k ? shN + (i * (a.waves * a.bases - 1) + k - 1) * 3 : sh0 + i * 3;
}

// Calls visit(index of the coefficient, harmonic, frequency) for all coefficients in use.
template <class Visit>
__device__ void each_coefficient(const ColorArgs& a, ColorOrder order, Visit visit) {
    for (int wave = 0; wave < order.waves; ++wave) {
        GSB_UNROLL for (int basis = 0; basis < MAX_BASIS; ++basis) {
            if (basis < (order.degree + 1) * (order.degree + 1)) visit(wave * a.bases + basis, basis, wave);
        }
    }
}

__device__ void sum_colors(const ColorArgs& a, ColorOrder order, const Weights& w, int64_t i, float (&color)[3]) {
    for (float& channel : color) channel = 0.5f;
    each_coefficient(a, order, [&](int k, int basis, int wave) {
        const float* p = coefficient(a, a.sh0, a.shN, i, k);
        const float weight = w.Y[basis] * w.cosines[wave];
        for (int channel = 0; channel < 3; ++channel) color[channel] += p[channel] * weight;
    });
}

__global__ void color_kernel(ColorArgs a, Colors out) {
    const int64_t i = global_thread();
    if (i >= a.N) return;
    const ColorOrder order = order_of(a, i);
    for (int64_t view = 0; view < a.V; ++view) {
        const Seen at(a, view, i);
        float color[3] = {};
        if (a.opacities[at.gaussian] >= ALPHA_MIN) sum_colors(a, order, Weights(a, order, at), i, color);
        for (int channel = 0; channel < 3; ++channel) {
            out.colors[at.color * 3 + channel] = color[channel] >= 0.0f ? color[channel] : CLAMPED;
        }
    }
}

// Adds to the gradients of Gaussian i's coefficients and of its mean time, and returns the gradient of its mean.
__device__ Vec3<float> color_vjp(const ColorArgs& a, const Seen& at, const float* color, const float (&given)[3],
                                 const ColorGrads& out, int64_t i, float& g_time) {
    const ColorOrder order = order_of(a, i);
    const Weights w(a, order, at);
    float g[3], g_Y[MAX_BASIS] = {};
    for (int channel = 0; channel < 3; ++channel) {
        g[channel] = 1.0f / color[channel] > 0.0f ? given[channel] : 0.0f;  // 1 / -0 is -inf
    }
    each_coefficient(a, order, [&](int k, int basis, int wave) {
        const float* p = coefficient(a, a.sh0, a.shN, i, k);
        float* g_p = coefficient(a, out.sh0, out.shN, i, k);
        const float weight = w.Y[basis] * w.cosines[wave];
        float along = 0.0f;
        for (int channel = 0; channel < 3; ++channel) {
            along += p[channel] * g[channel];
            g_p[channel] += g[channel] * weight;
        }
        g_Y[basis] += along * w.cosines[wave];
        g_time += along * w.Y[basis] * w.sines[wave] * (TURN * static_cast<float>(wave));  // by mu_t
    });
    return w.unit.vjp(harmonics_vjp(w.unit.direction, order.degree, g_Y));
}

// Coefficients of a Gaussian that is skipped, or whose colour has no gradient, are not touched.
__global__ void color_backward_kernel(ColorArgs a, ShownColors shown, GivenColors given, ColorGrads out) {
    const int64_t i = global_thread();
    if (i >= a.N) return;
    Vec3<float> g_mean{};  // of what all views share the sum
    float g_time = 0.0f;
    for (int64_t view = 0; view < a.V; ++view) {
        const Seen at(a, view, i);
        const float* from = given.colors + at.color * 3;
        const float g[3] = {from[0], from[1], from[2]};
        Vec3<float> g_mean_of_view{};
        float g_time_of_view = 0.0f;
        if (a.opacities[at.gaussian] >= ALPHA_MIN && (g[0] != 0.0f || g[1] != 0.0f || g[2] != 0.0f)) {
            g_mean_of_view = color_vjp(a, at, shown.colors + at.color * 3, g, out, i, g_time_of_view);
        }
        g_mean = a.gaussian_per_view ? g_mean_of_view : g_mean + g_mean_of_view;
        g_time = a.time_per_view ? g_time_of_view : g_time + g_time_of_view;
        float* to = out.means + at.gaussian * 3;
        to[0] = g_mean.x, to[1] = g_mean.y, to[2] = g_mean.z;
        if (a.times) out.times[at.time] = g_time;
    }
}

}  // namespace

void show_colors(const ColorArgs& a, const Colors& out, Stream stream) {
    if (a.N > 0) launch(color_kernel, blocks_for(a.N), THREADS, stream, a, out);
}

void show_colors_backward(const ColorArgs& a, const ShownColors& shown, const GivenColors& given, const ColorGrads& out,
                          Stream stream) {
    if (a.N > 0) launch(color_backward_kernel, blocks_for(a.N), THREADS, stream, a, shown, given, out);
}

}  // namespace gsb::cuda
