// Conditional 3D Gaussians of 4DGS Gaussians, sixteen at a time. math/rotated.h has the formulas, and math/static.h
// those of static Gaussians.
#include "../math/rotated.h"
#include "../math/static.h"

#include "buffer.h"
#include "isa.h"
#include "observation.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int64_t CHUNK = 512;  // Gaussians a task; the gradient of lambda is summed by chunks

// Times are multiplied by `clock` (world units per sequence length), because a rotation of space and time needs one
// unit.
GSB_HD inline void load(const RotatedArgs& a, int64_t i, int n, RotatedParameters<Vec>& p) {
    p.each(a, LoadRows{i, n});
    p.time = p.time * *a.clock;
    p.opacity = load_first(a.opacities + i, n);
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
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N - a.conditioned > CHUNK)
    for (int64_t i = a.conditioned; i < a.N; i += LANES) {
        const int n = lanes_from(i, a.N);
        StaticParameters<Vec> raw;
        load_static(a, i, n, raw);
        const StaticGaussian<Vec> seen(raw);
        copy_rows(a.means, out.means, 3, i, i + n);
        scatter_matrix(seen.factor, out.factors, i, n);
        store_first(seen.opacity, out.opacities + i, n);
    }
}

void slice_static_rows_backward(const RotatedArgs& a, const ObservationGrads& grads, const RotatedGrads& out) {
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N - a.conditioned > CHUNK)
    for (int64_t i = a.conditioned; i < a.N; i += LANES) {
        const int n = lanes_from(i, a.N);
        if (is_zero(grads, i, n)) continue;
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
    }
}

}  // namespace

void slice_rotated(const RotatedArgs& a, const Observation& out) {
    const float lambda_t = expf(*a.log_lambda_t), time = *a.time * *a.clock;
    slice_static_rows(a, out);
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.conditioned > CHUNK)
    for (int64_t i = 0; i < a.conditioned; i += LANES) {
        const int n = lanes_from(i, a.conditioned);
        RotatedParameters<Vec> raw;
        load(a, i, n, raw);
        store(RotatedGaussian<Vec>(raw, lambda_t, time).observe(), out, i, n);
    }
}

void slice_rotated_backward(const RotatedArgs& a, const ObservationGrads& grads, const RotatedGrads& out) {
    const float lambda_t = expf(*a.log_lambda_t), time = *a.time * *a.clock;
    slice_static_rows_backward(a, grads, out);
    const int64_t chunks = (a.conditioned + CHUNK - 1) / CHUNK;
    Buffer<float> lambdas(static_cast<size_t>(chunks));
#pragma omp parallel for num_threads(a.threads) schedule(static) if (chunks > 1)
    for (int64_t chunk = 0; chunk < chunks; ++chunk) {
        const int64_t end = (chunk + 1) * CHUNK < a.conditioned ? (chunk + 1) * CHUNK : a.conditioned;
        Vec g_lambda(0.0f);
        for (int64_t i = chunk * CHUNK; i < end; i += LANES) {
            const int n = lanes_from(i, end);
            if (is_zero(grads, i, n)) continue;
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
            g_lambda += g.lambda_t;  // lanes past the end were given zero
        }
        lambdas[static_cast<size_t>(chunk)] = sum(g_lambda);
    }
    double total = 0.0;
    for (size_t k = 0; k < static_cast<size_t>(chunks); ++k) total += lambdas[k];
    *out.log_lambda_t = static_cast<float>(total) * lambda_t;
}

}  // namespace GSB_ISA
}  // namespace gsb
