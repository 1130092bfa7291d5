// Factors and opacities of 3DGS Gaussians, sixteen at a time; math/static.h has the formulas.
#include "../math/static.h"

#include "isa.h"
#include "rows.h"

namespace gsb {
inline namespace GSB_ISA {

void slice_static(const StaticArgs& a, const StaticSlice& out) {
    each_sixteen(0, a.N, a.threads, [&](int64_t i, int n) {
        const auto raw = load_raw<StaticParameters<Vec>>(a, i, n);
        const StaticGaussian<Vec> seen(raw);
        scatter_matrix(seen.factor, out.factors, i, n);
        store_first(seen.opacity, out.opacities + i, n);
    });
}

void slice_static_backward(const StaticArgs& a, const StaticSliceGrads& grads, const StaticGrads& out) {
    each_sixteen(0, a.N, a.threads, [&](int64_t i, int n) {
        if (all_zero(grads.opacities, 1, i, n) && all_zero(grads.factors, 9, i, n)) return;
        const auto raw = load_raw<StaticParameters<Vec>>(a, i, n);
        StaticParameters<Vec> g;
        Vec g_factor[3][3];
        gather_matrix(grads.factors, i, n, g_factor);
        StaticGaussian<Vec>(raw).vjp(g_factor, load_first(grads.opacities + i, n), g);
        g.each(out, AddRows{i, n});
        add_first(g.opacity, out.opacities + i, n);
    });
}

}  // namespace GSB_ISA
}  // namespace gsb
