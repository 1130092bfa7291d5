// Blends projected Gaussians into images, front to back: one warp per patch, one lane per pixel.
#include "patch.h"

namespace gsb::cuda {
namespace {

template <class Profile>
__global__ void __launch_bounds__(PATCHES * WARP) blend_kernel(BlendArgs a, Picture out, int first_channel) {
    __shared__ StagedSplat shared[PATCHES][WARP];
    StagedSplat* staged = shared[threadIdx.x / WARP];
    const Patch<Profile> patch(a, first_channel);
    const float x = static_cast<float>(patch.x(patch.lane)) + 0.5f, y = static_cast<float>(patch.y(patch.lane)) + 0.5f;
    bool open = patch.inside(patch.lane);
    float T = 1.0f, color[CHANNELS] = {};
    int stop = 0;
    for (int first = 0; first < patch.size; first += WARP) {
        if (!__any_sync(ALL_LANES, open)) break;
        const int n = patch.stage(first, staged);
        for (int i = 0; i < n; ++i) {
            const StagedSplat& s = staged[i];
            const Falloff<float, Profile> f(x - s.x, y - s.y, s);
            if (!open || f.alpha < ALPHA_MIN) continue;
            const float after = T - T * f.alpha;
            if (after < TRANSMITTANCE_MIN) {
                open = false;
                continue;
            }
            for (int k = 0; k < CHANNELS; ++k) color[k] += T * f.alpha * s.color[k];
            T = after;
            stop = s.position + 1;
        }
        __syncwarp();
    }
    if (!patch.inside(patch.lane)) return;
    const int64_t pixel = patch.pixel(patch.lane);
    for (int k = 0; k < patch.count; ++k) {
        const int channel = first_channel + k;
        out.image[pixel * a.D + channel] = color[k] + T * a.background[channel];
    }
    out.alpha[pixel] = 1.0f - T;
    out.transmittance[pixel] = T;
    reinterpret_cast<int32_t*>(out.stop)[pixel] = stop;  // the place of the last splat that counts, plus one
}

}  // namespace

void blend(const BlendArgs& a, const Picture& out, Stream stream) {
    for (int first = 0; first < a.D; first += CHANNELS) {
        launch(a.shapes ? blend_kernel<Beta> : blend_kernel<Gaussian>, tiles_of(a), PATCHES * WARP, stream, a, out,
               first);
    }
}

}  // namespace gsb::cuda
