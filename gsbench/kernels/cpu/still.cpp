// Factors and opacities of Gaussians that are their own slice, sixteen at a time; the mathematics is math/still.h.
#include "../math/still.h"

#include "isa.h"
#include "rows.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int64_t FEW = 512;  // Gaussians that are not worth a second thread

GSB_HD inline void load(const StillArgs& a, int64_t i, int n, StillParameters<Vec>& p) {
    gather_row(a.scales, i, n, p.scales);
    gather_row(a.quats, i, n, p.quat);
    p.opacity = load_first(a.opacities + i, n);
}

}  // namespace

void observe_still(const StillArgs& a, const StillSlice& out) {
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N > FEW)
    for (int64_t i = 0; i < a.N; i += LANES) {
        const int n = lanes_from(i, a.N);
        StillParameters<Vec> raw;
        load(a, i, n, raw);
        const StillGaussian<Vec> seen(raw);
        scatter_matrix(seen.factor, out.factors, i, n);
        store_first(seen.opacity, out.opacities + i, n);
    }
}

void observe_still_backward(const StillArgs& a, const StillSliceGrads& grads, const StillGrads& out) {
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N > FEW)
    for (int64_t i = 0; i < a.N; i += LANES) {
        const int n = lanes_from(i, a.N);
        StillParameters<Vec> raw, g;
        Vec g_factor[3][3];
        load(a, i, n, raw);
        gather_matrix(grads.factors, i, n, g_factor);
        StillGaussian<Vec>(raw).vjp(g_factor, load_first(grads.opacities + i, n), g);
        scatter_row(g.scales, out.scales, i, n);
        scatter_row(g.quat, out.quats, i, n);
        store_first(g.opacity, out.opacities + i, n);
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
