// Factors and opacities of 3DGS Gaussians and their gradients, one Gaussian per thread; math/static.h has the formulas.
#include "../math/static.h"

#include "rows.h"

namespace gsb::cuda {
namespace {

__global__ void static_kernel(StaticArgs a, StaticSlice out) {
    const int64_t i = global_thread();
    if (i >= a.N) return;
    for (int64_t row = i; row < a.V * a.N; row += a.N) {
        const auto raw = load_raw<StaticParameters<float>>(a, row, i);
        const StaticGaussian<float> seen(raw);
        store_matrix(seen.factor, out.factors, row);
        out.opacities[row] = seen.opacity;
    }
}

__global__ void static_backward_kernel(StaticArgs a, StaticSliceGrads grads, StaticGrads out) {
    const int64_t i = global_thread();
    if (i >= a.N) return;
    float g_opacity = 0.0f;
    for (int64_t row = i; row < a.V * a.N; row += a.N) {
        const auto raw = load_raw<StaticParameters<float>>(a, row, i);
        StaticParameters<float> g{};
        float g_factor[3][3];
        load_matrix(grads.factors, row, g_factor);
        StaticGaussian<float>(raw).vjp(g_factor, grads.opacities[row], g);
        g.each(out, AddRow{row});
        g_opacity += g.opacity;
    }
    out.opacities[i] += g_opacity;
}

}  // namespace

void slice_static(const StaticArgs& a, const StaticSlice& out, Stream stream) {
    if (a.N > 0) launch(static_kernel, small_blocks(a.N), SMALL_BLOCK, stream, a, out);
}

void slice_static_backward(const StaticArgs& a, const StaticSliceGrads& grads, const StaticGrads& out, Stream stream) {
    if (a.N > 0) launch(static_backward_kernel, small_blocks(a.N), SMALL_BLOCK, stream, a, grads, out);
}

}  // namespace gsb::cuda
