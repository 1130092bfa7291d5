// Conditional 3D Gaussians of Universal Beta Splatting, sixteen at a time; the mathematics is math/universal.h.
#include "../math/universal.h"

#include "isa.h"
#include "observation.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

ViewPoint view_of(const UniversalArgs& a) {
    return {{a.center[0], a.center[1], a.center[2]}, a.times ? *a.time : 0.0f};
}

template <bool TIME>
GSB_HD inline void load(const UniversalArgs& a, int64_t i, int n, UniversalParameters<Vec, TIME>& p) {
    gather_row(a.means, i, n, p.mean);
    gather_row(a.directions, i, n, p.direction);
    if constexpr (TIME) p.time = load_first(a.times + i, n);
    gather_row(a.scales, i, n, p.scales);
    gather_row(a.skew, i, n, p.skew);
    gather_row(a.lower, i, n, p.lower);
    gather_row(a.betas, i, n, p.betas);
    p.opacity = load_first(a.opacities + i, n);
}

template <bool TIME>
void observe(const UniversalArgs& a, const BetaSlice& out) {
    const ViewPoint view = view_of(a);
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N > 512)
    for (int64_t i = 0; i < a.N; i += LANES) {
        const int n = lanes_from(i, a.N);
        UniversalParameters<Vec, TIME> raw;
        load<TIME>(a, i, n, raw);
        UniversalGaussian<Vec, TIME> gaussian(view, raw);
        store(gaussian.observe(), out, i, n);
    }
}

template <bool TIME>
void observe_backward(const UniversalArgs& a, const BetaSliceGrads& grads, const UniversalGrads& out) {
    const ViewPoint view = view_of(a);
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N > 512)
    for (int64_t i = 0; i < a.N; i += LANES) {
        const int n = lanes_from(i, a.N);
        if (is_zero(grads, i, n)) continue;
        UniversalParameters<Vec, TIME> raw, g;
        ObservedBeta<Vec> given;
        load<TIME>(a, i, n, raw);
        load(grads, i, n, given);
        UniversalGaussian<Vec, TIME> gaussian(view, raw);
        gaussian.observe();
        gaussian.vjp(given, g);
        add_row(g.mean, out.means, i, n);
        add_row(g.direction, out.directions, i, n);
        if constexpr (TIME) add_first(g.time, out.times + i, n);
        add_row(g.scales, out.scales, i, n);
        add_row(g.skew, out.skew, i, n);
        add_row(g.lower, out.lower, i, n);
        add_row(g.betas, out.betas, i, n);
        add_first(g.opacity, out.opacities + i, n);
    }
}

}  // namespace

void slice_universal(const UniversalArgs& a, const BetaSlice& out) {
    a.times ? observe<true>(a, out) : observe<false>(a, out);
}

void slice_universal_backward(const UniversalArgs& a, const BetaSliceGrads& grads, const UniversalGrads& out) {
    a.times ? observe_backward<true>(a, grads, out) : observe_backward<false>(a, grads, out);
}

}  // namespace GSB_ISA
}  // namespace gsb
