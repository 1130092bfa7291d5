// Conditional 3D Gaussians of Universal Beta Splatting and their gradients, one Gaussian per thread. math/universal.h
// has the formulas.
#include "../math/universal.h"

#include "rows.h"

namespace gsb::cuda {
namespace {

template <bool TIME>
__global__ void universal_kernel(UniversalArgs a, BetaSlice out) {
    const int64_t i = global_thread();
    if (i >= a.N) return;
    for (int64_t view = 0; view < a.V; ++view) {
        const ViewPoint from = view_of(a, view);
        const auto raw = load_raw<UniversalParameters<float, TIME>>(a, raw_row(a, view, i), i);
        store_observed(UniversalGaussian<float, TIME>(from, raw).observe(), out, view * a.N + i);
    }
}

template <bool TIME>
__global__ void universal_backward_kernel(UniversalArgs a, BetaSliceGrads grads, UniversalGrads out) {
    const int64_t i = global_thread();
    if (i >= a.N) return;
    for (int64_t view = 0; view < a.V; ++view) {
        const int64_t row = raw_row(a, view, i);
        const ViewPoint from = view_of(a, view);
        const auto raw = load_raw<UniversalParameters<float, TIME>>(a, row, i);
        UniversalParameters<float, TIME> g{};
        UniversalGaussian<float, TIME> gaussian(from, raw);
        gaussian.observe();
        gaussian.vjp(load_observed(grads, view * a.N + i), g);
        // A sum over the views would need more than all registers.
        g.each(out, AddRow{row});
        out.opacities[i] += g.opacity;
    }
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
