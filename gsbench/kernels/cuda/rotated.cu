// Conditional 3D Gaussians of 4DGS Gaussians and their gradients, one Gaussian per thread. math/rotated.h has the
// formulas, and math/static.h those of static Gaussians.
#include "../math/rotated.h"
#include "../math/static.h"

#include "rows.h"

namespace gsb::cuda {
namespace {

// Times are multiplied by `clock` (world units per sequence length), because a rotation of space and time needs one
// unit.
__device__ RotatedParameters<float> parameters(const RotatedArgs& a, int64_t row, int64_t i) {
    RotatedParameters<float> p = load_raw<RotatedParameters<float>>(a, row, i);
    p.time *= *a.clock;
    return p;
}

__device__ StaticParameters<float> static_parameters(const RotatedArgs& a, int64_t row, int64_t i) {
    StaticParameters<float> p{};
    float left[4];
    GSB_UNROLL for (int k = 0; k < 3; ++k) p.scales[k] = a.scales[row * 4 + k];
    load_row(a.left_quats, row, left);
    turn_of_space(left, p.quat);
    p.opacity = a.opacities[i];
    return p;
}

__global__ void observe_kernel(RotatedArgs a, Observation out) {
    const int64_t i = global_thread();
    if (i >= a.N) return;
    for (int64_t view = 0; view < a.V; ++view) {
        const int64_t row = raw_row(a, view, i), at = view * a.N + i;
        if (i >= a.conditioned) {
            const StaticParameters<float> raw = static_parameters(a, row, i);
            store_static(StaticGaussian<float>(raw), a.means, row, out, at);
            continue;
        }
        const RotatedParameters<float> raw = parameters(a, row, i);
        store_observed(RotatedGaussian<float>(raw, expf(*a.log_lambda_t), a.time[view] * *a.clock).observe(), out, at);
    }
}

__global__ void observe_backward_kernel(RotatedArgs a, ObservationGrads grads, RotatedGrads out) {
    const int64_t i = global_thread();
    RotatedParameters<float> sum{};
    for (int64_t view = 0; view < (i < a.N ? a.V : 0); ++view) {
        const int64_t row = raw_row(a, view, i);
        const Observed<float> given = load_observed(grads, view * a.N + i);
        RotatedParameters<float> g{};  // of a static row mostly zero
        if (i >= a.conditioned) {
            const StaticParameters<float> raw = static_parameters(a, row, i);
            StaticParameters<float> g_static{};
            StaticGaussian<float>(raw).vjp(given.factor, given.opacity, g_static);
            GSB_UNROLL for (int k = 0; k < 3; ++k) {
                g.mean[k] = given.mean[k];
                g.scales[k] = g_static.scales[k];
            }
            turn_of_space(g_static.quat, g.left);
            g.opacity = g_static.opacity;
        } else {
            const RotatedParameters<float> raw = parameters(a, row, i);
            RotatedGaussian<float> gaussian(raw, expf(*a.log_lambda_t), a.time[view] * *a.clock);
            gaussian.observe();
            gaussian.vjp(given, g);
            g.time *= *a.clock;
        }
        accumulate(sum, g);
        if (a.raw_per_view) g.each(out, AddRow{row});
    }
    if (i < a.N) {
        if (!a.raw_per_view) sum.each(out, AddRow{i});
        out.opacities[i] += sum.opacity;
    }
    const float lambda_t = warp_sum(sum.lambda_t);
    if (threadIdx.x % WARP == 0) atomicAdd(out.log_lambda_t, lambda_t * expf(*a.log_lambda_t));
}

}  // namespace

void slice_rotated(const RotatedArgs& a, const Observation& out, Stream stream) {
    if (a.N > 0) launch(observe_kernel, small_blocks(a.N), SMALL_BLOCK, stream, a, out);
}

void slice_rotated_backward(const RotatedArgs& a, const ObservationGrads& grads, const RotatedGrads& out,
                              Stream stream) {
    if (a.N > 0) launch(observe_backward_kernel, small_blocks(a.N), SMALL_BLOCK, stream, a, grads, out);
}

}  // namespace gsb::cuda
