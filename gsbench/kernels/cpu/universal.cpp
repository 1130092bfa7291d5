// Conditional 3D Gaussians of Universal Beta Splatting, sixteen at a time; the mathematics is math/universal.h.
#include "../math/universal.h"

#include "isa.h"
#include "observation.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

template <bool TIME>
void observe(const UniversalArgs& a, const BetaSlice& out) {
    const ViewPoint view = view_of(a);
    each_sixteen(0, a.N, a.threads, [&](int64_t i, int n) {
        const auto raw = load_raw<UniversalParameters<Vec, TIME>>(a, i, n);
        UniversalGaussian<Vec, TIME> gaussian(view, raw);
        store(gaussian.observe(), out, i, n);
    });
}

template <bool TIME>
void observe_backward(const UniversalArgs& a, const BetaSliceGrads& grads, const UniversalGrads& out) {
    const ViewPoint view = view_of(a);
    each_sixteen(0, a.N, a.threads, [&](int64_t i, int n) {
        if (is_zero(grads, i, n)) return;
        const auto raw = load_raw<UniversalParameters<Vec, TIME>>(a, i, n);
        UniversalParameters<Vec, TIME> g;
        ObservedBeta<Vec> given;
        load(grads, i, n, given);
        UniversalGaussian<Vec, TIME> gaussian(view, raw);
        gaussian.observe();
        gaussian.vjp(given, g);
        g.each(out, AddRows{i, n});
        add_first(g.opacity, out.opacities + i, n);
    });
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
