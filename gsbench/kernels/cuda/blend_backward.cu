// The gradients of blending: sums over pixels by one of two kernels, then the gradients of each projected Gaussian
// (splat) from its sums, and the gradient of the background.
#include "blend_backward.h"

namespace gsb::cuda {
namespace {

// Computes the gradients of a Gaussian's splats and of its colour from their sums.
template <class Profile>
__global__ void finish_kernel(BlendArgs a, BlendGrads out) {
    constexpr int GEOMETRY = Profile::MOMENTS;
    const int64_t i = global_thread();
    if (i >= a.N) return;
    for (int64_t c = blockIdx.y; c < a.C; c += gridDim.y) {
        const int64_t s = c * a.N + i;
        const float* sums = out.scratch + s * (GEOMETRY + a.D);
        bool any = false;
        for (int k = 0; k < GEOMETRY; ++k) any |= sums[k] != 0.0f;
        float g[GEOMETRY] = {};
        if (any) {  // else the splat may be one that was never drawn, and not finite
            FalloffMoments<float, Profile> m;
            for (int k = 0; k < GEOMETRY; ++k) m.of[k] = sums[k];
            const float4 root = reinterpret_cast<const float4*>(a.roots)[s];
            StagedSplat splat{};
            splat.p = root.x, splat.q = root.y, splat.r = root.z, splat.opacity = root.w;
            if constexpr (Profile::HAS_SHAPE) splat.shape = a.shapes[a.shape_per_camera ? s : i];
            splat_gradient(m, splat, g);
        }
        reinterpret_cast<float2*>(out.means2d)[s] = {g[0], g[1]};
        reinterpret_cast<float4*>(out.roots)[s] = {g[2], g[3], g[4], g[5]};
        if constexpr (Profile::HAS_SHAPE) {
            float* shape = out.shapes + (a.shape_per_camera ? s : i);
            *shape = g[6] + (a.shape_per_camera || c == 0 ? 0.0f : *shape);
        }
        float* color = out.colors + (a.color_per_camera ? s : i) * a.D;
        for (int k = 0; k < a.D; ++k) {
            color[k] = sums[GEOMETRY + k] + (a.color_per_camera || c == 0 ? 0.0f : color[k]);
        }
    }
}

// A pixel shows the background with the transmittance that is left after all splats.
__global__ void background_kernel(BlendArgs a, BlendState picture, PictureGrads grads, float* out, int first_channel) {
    const int64_t pixels = a.C * a.height * a.width, step = static_cast<int64_t>(gridDim.x) * blockDim.x;
    const int count = a.D - first_channel < CHANNELS ? a.D - first_channel : CHANNELS;
    float sums[CHANNELS] = {};
    for (int64_t pixel = global_thread(); pixel < pixels; pixel += step) {
        const float* g = grads.image + pixel * a.D + first_channel;
        for (int c = 0; c < CHANNELS; ++c) sums[c] += c < count ? g[c] * picture.transmittance[pixel] : 0.0f;
    }
    for (int c = 0; c < CHANNELS; ++c) {
        const float sum = warp_sum(sums[c]);
        if (threadIdx.x % WARP == 0 && c < count) atomicAdd(out + first_channel + c, sum);
    }
}

void backward(SumUp sum_up, const BlendArgs& a, const BlendState& picture, const PictureGrads& grads,
              const BlendGrads& out, Stream stream) {
    constexpr unsigned MOST_BLOCKS = 256;  // their warps wait for each other to add to the background's few numbers
    const unsigned blocks = blocks_for(a.C * a.height * a.width);
    for (int first = 0; first < a.D; first += CHANNELS) {
        if (a.N > 0) sum_up(a, picture, grads, out, first, stream);
        if (!out.background) continue;
        launch(background_kernel, blocks < MOST_BLOCKS ? blocks : MOST_BLOCKS, THREADS, stream, a, picture, grads,
               out.background, first);
    }
    if (a.N == 0) return;
    // The gradients of a colour or shape that all cameras see are added up in one thread.
    const bool per_camera = a.color_per_camera && (!a.shapes || a.shape_per_camera);
    const dim3 grid(blocks_for(a.N), per_camera ? rows_for(a.C) : 1);
    launch(a.shapes ? finish_kernel<Beta> : finish_kernel<Gaussian>, grid, THREADS, stream, a, out);
}

}  // namespace

void blend_backward(const BlendArgs& a, const BlendState& picture, const PictureGrads& grads, const BlendGrads& out,
                    Stream stream) {
    backward(sum_by_pixel, a, picture, grads, out, stream);
}

void blend_backward_by_splat(const BlendArgs& a, const BlendState& picture, const PictureGrads& grads,
                             const BlendGrads& out, Stream stream) {
    backward(sum_by_splat, a, picture, grads, out, stream);
}

}  // namespace gsb::cuda
