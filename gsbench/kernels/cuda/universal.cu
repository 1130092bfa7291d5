// Conditional 3D Gaussians of Universal Beta Splatting and their gradients, one Gaussian per thread. math/universal.h
// has the formulas.
#include "../math/universal.h"

#include "rows.h"

namespace gsb::cuda {
namespace {

template <bool TIME>
__device__ ViewPoint view_of(const UniversalArgs& a) {
    return {{a.center[0], a.center[1], a.center[2]}, TIME ? *a.time : 0.0f};
}

template <bool TIME>
__device__ UniversalParameters<float, TIME> parameters(const UniversalArgs& a, int64_t i) {
    UniversalParameters<float, TIME> p{};
    load_row(a.means, i, p.mean);
    load_row(a.directions, i, p.direction);
    if constexpr (TIME) p.time = a.times[i];
    load_row(a.scales, i, p.scales);
    load_row(a.skew, i, p.skew);
    load_row(a.lower, i, p.lower);
    load_row(a.betas, i, p.betas);
    p.opacity = a.opacities[i];
    return p;
}

template <bool TIME>
__global__ void universal_kernel(UniversalArgs a, BetaSlice out) {
    const int64_t i = global_thread();
    if (i >= a.N) return;
    const ViewPoint view = view_of<TIME>(a);
    const auto raw = parameters<TIME>(a, i);
    store_observed(UniversalGaussian<float, TIME>(view, raw).observe(), out, i);
}

template <bool TIME>
__global__ void universal_backward_kernel(UniversalArgs a, BetaSliceGrads grads, UniversalGrads out) {
    const int64_t i = global_thread();
    if (i >= a.N) return;
    const ViewPoint view = view_of<TIME>(a);
    const auto raw = parameters<TIME>(a, i);
    UniversalParameters<float, TIME> g{};
    UniversalGaussian<float, TIME> gaussian(view, raw);
    gaussian.observe();
    gaussian.vjp(load_observed(grads, i), g);
    add_row(g.mean, out.means, i);
    add_row(g.direction, out.directions, i);
    if constexpr (TIME) out.times[i] += g.time;
    add_row(g.scales, out.scales, i);
    add_row(g.skew, out.skew, i);
    add_row(g.lower, out.lower, i);
    add_row(g.betas, out.betas, i);
    out.opacities[i] += g.opacity;
}

}  // namespace

void slice_universal(const UniversalArgs& a, const BetaSlice& out, Stream stream) {
    if (a.N == 0) return;
    const auto kernel = a.times ? universal_kernel<true> : universal_kernel<false>;
    launch(kernel, small_blocks(a.N), SMALL_BLOCK, stream, a, out);
}

void slice_universal_backward(const UniversalArgs& a, const BetaSliceGrads& grads, const UniversalGrads& out,
                              Stream stream) {
    if (a.N == 0) return;
    const auto kernel = a.times ? universal_backward_kernel<true> : universal_backward_kernel<false>;
    launch(kernel, small_blocks(a.N), SMALL_BLOCK, stream, a, grads, out);
}

}  // namespace gsb::cuda
