// Factors and opacities of 3DGS Gaussians, sixteen at a time; math/static.h has the formulas.
#include "../math/static.h"

#include "isa.h"
#include "rows.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int64_t FEW = 512;  // Gaussians that are not worth a second thread

}  // namespace

void slice_static(const StaticArgs& a, const StaticSlice& out) {
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N > FEW)
    for (int64_t i = 0; i < a.N; i += LANES) {
        const int n = lanes_from(i, a.N);
        StaticParameters<Vec> raw;
        raw.each(a, LoadRows{i, n});
        raw.opacity = load_first(a.opacities + i, n);
        const StaticGaussian<Vec> seen(raw);
        scatter_matrix(seen.factor, out.factors, i, n);
        store_first(seen.opacity, out.opacities + i, n);
    }
}

void slice_static_backward(const StaticArgs& a, const StaticSliceGrads& grads, const StaticGrads& out) {
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N > FEW)
    for (int64_t i = 0; i < a.N; i += LANES) {
        const int n = lanes_from(i, a.N);
        if (all_zero(grads.opacities, 1, i, n) && all_zero(grads.factors, 9, i, n)) continue;
        StaticParameters<Vec> raw, g;
        Vec g_factor[3][3];
        raw.each(a, LoadRows{i, n});
        raw.opacity = load_first(a.opacities + i, n);
        gather_matrix(grads.factors, i, n, g_factor);
        StaticGaussian<Vec>(raw).vjp(g_factor, load_first(grads.opacities + i, n), g);
        g.each(out, AddRows{i, n});
        add_first(g.opacity, out.opacities + i, n);
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
