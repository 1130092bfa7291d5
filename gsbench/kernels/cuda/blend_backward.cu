// The derivative of blending: sums over pixels by one of two kernels, then each splat's gradient from its sums.
#include "blend_backward.h"

namespace gsb::cuda {
namespace {

// A Gaussian's rows of sums to the gradients of its splats and of its colour.
__global__ void finish_kernel(BlendArgs a, BlendGrads grads) {
    const int64_t i = global_thread();
    if (i >= a.N) return;
    for (int64_t c = 0; c < a.C; ++c) {
        const int64_t s = c * a.N + i;
        const float* sums = grads.sums + s * (GEOMETRY + a.D);
        bool any = false;
        for (int k = 0; k < GEOMETRY; ++k) any |= sums[k] != 0.0f;
        float g[GEOMETRY] = {};
        if (any) {  // else the splat may be one that was never drawn, and not finite
            const FalloffMoments<float> m{sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]};
            const float4 root = reinterpret_cast<const float4*>(a.roots)[s];
            splat_gradient(m, root.x, root.y, root.z, root.w, g);
        }
        reinterpret_cast<float2*>(grads.means2d)[s] = {g[0], g[1]};
        reinterpret_cast<float4*>(grads.roots)[s] = {g[2], g[3], g[4], g[5]};
        float* color = grads.colors + (a.color_per_camera ? s : i) * a.D;
        for (int k = 0; k < a.D; ++k) {
            color[k] = sums[GEOMETRY + k] + (a.color_per_camera || c == 0 ? 0.0f : color[k]);
        }
    }
}

}  // namespace

void blend_backward(const BlendArgs& a, const Picture& picture, const BlendGrads& grads, bool by_splat, Stream stream) {
    if (a.N == 0) return;
    const auto sum_up = by_splat ? blend_backward_by_splat : blend_backward_by_pixel;
    for (int first = 0; first < a.D; first += CHANNELS) sum_up(a, picture, grads, first, stream);
    launch(finish_kernel, blocks_for(a.N), THREADS, stream, a, grads);
}

}  // namespace gsb::cuda
