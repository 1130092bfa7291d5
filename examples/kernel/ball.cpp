// Factors and opacities of balls, sixteen at a time; the mathematics is math/ball.h.
#include "../math/ball.h"

#include "isa.h"
#include "rows.h"

namespace gsb {
inline namespace GSB_ISA {

void slice_ball(const BallArgs& a, const StaticSlice& out) {
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N > 512)
    for (int64_t i = 0; i < a.N; i += LANES) {
        const int n = lanes_from(i, a.N);
        const Ball<Vec> ball(load_first(a.radii + i, n), load_first(a.opacities + i, n));
        Vec factor[3][3];
        ball.factor(factor);
        scatter_matrix(factor, out.factors, i, n);
        store_first(ball.opacity, out.opacities + i, n);
    }
}

void slice_ball_backward(const BallArgs& a, const StaticSliceGrads& given, const BallGrads& out) {
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N > 512)
    for (int64_t i = 0; i < a.N; i += LANES) {
        const int n = lanes_from(i, a.N);
        const Ball<Vec> ball(load_first(a.radii + i, n), load_first(a.opacities + i, n));
        Vec g_factor[3][3];
        gather_matrix(given.factors, i, n, g_factor);
        store_first(ball.radius_vjp(g_factor), out.radii + i, n);
        store_first(ball.opacity_vjp(load_first(given.opacities + i, n)), out.opacities + i, n);
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
