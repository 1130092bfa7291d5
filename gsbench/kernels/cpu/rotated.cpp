// Conditional 3D Gaussians of 4DGS Gaussians, sixteen at a time. math/rotated.h has the formulas, and math/static.h
// those of static Gaussians.
#include "../math/rotated.h"
#include "../math/static.h"

#include "isa.h"
#include "observation.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

// Times are multiplied by `clock` (world units per sequence length), because a rotation of space and time needs one
// unit.
GSB_HD inline void load(const RotatedArgs& a, int64_t i, int n, RotatedParameters<Vec>& p) {
    p = load_raw<RotatedParameters<Vec>>(a, i, n);
    p.time = p.time * *a.clock;
    if (n == LANES) return;
    const Mask real = Vec::load(INDEX) < Vec(static_cast<float>(n));  // what is no Gaussian gets harmless quaternions
    p.left[0] = select(real, p.left[0], Vec(1.0f));
    p.right[0] = select(real, p.right[0], Vec(1.0f));
}

GSB_HD inline void load_static(const RotatedArgs& a, int64_t i, int n, StaticParameters<Vec>& p) {
    Vec left[4];
    gather_columns(a.scales, 4, 0, i, n, p.scales);
    gather_row(a.left_quats, i, n, left);
    turn_of_space(left, p.quat);
    p.opacity = load_first(a.opacities + i, n);
}

void slice_static_rows(const RotatedArgs& a, const Observation& out) {
    each_sixteen(a.conditioned, a.N, a.threads, [&](int64_t i, int n) {
        StaticParameters<Vec> raw;
        load_static(a, i, n, raw);
        const StaticGaussian<Vec> seen(raw);
        copy_rows(a.means, out.means, 3, i, i + n);
        scatter_matrix(seen.factor, out.factors, i, n);
        store_first(seen.opacity, out.opacities + i, n);
    });
}

void slice_static_rows_backward(const RotatedArgs& a, const ObservationGrads& grads, const RotatedGrads& out) {
    each_sixteen(a.conditioned, a.N, a.threads, [&](int64_t i, int n) {
        if (is_zero(grads, i, n)) return;
        StaticParameters<Vec> raw, g;
        Observed<Vec> given;
        Vec g_left[4];
        load_static(a, i, n, raw);
        load(grads, i, n, given);
        StaticGaussian<Vec>(raw).vjp(given.factor, given.opacity, g);
        turn_of_space(g.quat, g_left);
        add_row(given.mean, out.means, i, n);
        add_columns(g.scales, out.scales, 4, 0, i, n);
        add_row(g_left, out.left_quats, i, n);
        add_first(g.opacity, out.opacities + i, n);
    });
}

}  // namespace

void slice_rotated(const RotatedArgs& a, const Observation& out) {
    const float lambda_t = expf(*a.log_lambda_t), time = *a.time * *a.clock;
    slice_static_rows(a, out);
    each_sixteen(0, a.conditioned, a.threads, [&](int64_t i, int n) {
        RotatedParameters<Vec> raw;
        load(a, i, n, raw);
        store(RotatedGaussian<Vec>(raw, lambda_t, time).observe(), out, i, n);
    });
}

void slice_rotated_backward(const RotatedArgs& a, const ObservationGrads& grads, const RotatedGrads& out) {
    const float lambda_t = expf(*a.log_lambda_t), time = *a.time * *a.clock;
    slice_static_rows_backward(a, grads, out);
    double total[1];
    sum_sixteens(a.conditioned, a.threads, total, [&](int64_t i, int n, Vec (&g_lambda)[1]) {
        if (is_zero(grads, i, n)) return;
        RotatedParameters<Vec> raw, g;
        Observed<Vec> given;
        load(a, i, n, raw);
        load(grads, i, n, given);
        RotatedGaussian<Vec> gaussian(raw, lambda_t, time);
        gaussian.observe();
        gaussian.vjp(given, g);
        g.time = g.time * *a.clock;
        g.each(out, AddRows{i, n});
        add_first(g.opacity, out.opacities + i, n);
        g_lambda[0] += g.lambda_t;  // lanes past the end were given zero
    });
    *out.log_lambda_t = static_cast<float>(total[0]) * lambda_t;
}

}  // namespace GSB_ISA
}  // namespace gsb
