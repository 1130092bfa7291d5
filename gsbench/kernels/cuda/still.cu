// Factors and opacities of Gaussians that are their own slice, one a thread; the mathematics is math/still.h.
#include "../math/still.h"

#include "rows.h"

namespace gsb::cuda {
namespace {

__device__ StillParameters<float> parameters(const StillArgs& a, int64_t i) {
    StillParameters<float> p{};
    load_row(a.scales, i, p.scales);
    load_row(a.quats, i, p.quat);
    p.opacity = a.opacities[i];
    return p;
}

__global__ void still_kernel(StillArgs a, StillSlice out) {
    const int64_t i = global_thread();
    if (i >= a.N) return;
    const StillParameters<float> raw = parameters(a, i);
    const StillGaussian<float> seen(raw);
    store_matrix(seen.factor, out.factors, i);
    out.opacities[i] = seen.opacity;
}

__global__ void still_backward_kernel(StillArgs a, StillSliceGrads grads, StillGrads out) {
    const int64_t i = global_thread();
    if (i >= a.N) return;
    const StillParameters<float> raw = parameters(a, i);
    StillParameters<float> g{};
    float g_factor[3][3];
    load_matrix(grads.factors, i, g_factor);
    StillGaussian<float>(raw).vjp(g_factor, grads.opacities[i], g);
    store_row(g.scales, out.scales, i);
    store_row(g.quat, out.quats, i);
    out.opacities[i] = g.opacity;
}

}  // namespace

void observe_still(const StillArgs& a, const StillSlice& out, Stream stream) {
    if (a.N > 0) launch(still_kernel, small_blocks(a.N), SMALL_BLOCK, stream, a, out);
}

void observe_still_backward(const StillArgs& a, const StillSliceGrads& grads, const StillGrads& out, Stream stream) {
    if (a.N > 0) launch(still_backward_kernel, small_blocks(a.N), SMALL_BLOCK, stream, a, grads, out);
}

}  // namespace gsb::cuda
