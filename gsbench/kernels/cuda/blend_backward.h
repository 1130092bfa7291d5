// Shared code of the two kernels for the gradients of blending, back to front. In both, a warp processes a patch of 8 x
// 4 pixels and sums over these pixels for each projected Gaussian (splat). A lane of the warp holds a pixel in one
// kernel, and a splat in the other.
#pragma once

#include "patch.h"

namespace gsb::cuda {

// A pixel of the image: its position, how many splats of the tile's list it blended, and the gradients of the loss by
// its alpha and its colour. They are two structures of four numbers each, so that 32 lanes read them without bank
// conflicts in shared memory.
struct alignas(16) Place {
    float x, y;
    int stop;
    float alpha;
};
struct alignas(16) ColorGrad {
    float of[CHANNELS];
};

// What changes at a pixel from splat to splat: the transmittance T in front of the splats processed so far, and the
// colour seen of these splats, multiplied by the pixel's gradient. At first this is the background, whose alpha is
// zero.
struct Behind {
    float T, seen;
};

struct BackwardPixel {
    Place place{};
    ColorGrad color{};
    Behind behind{1.0f, 0.0f};

    // Loads pixel number `k` of the patch; outside of the image nothing was blended.
    template <class Profile>
    __device__ BackwardPixel(const Patch<Profile>& patch, int k, const BlendState& picture, const PictureGrads& grads) {
        place.x = static_cast<float>(patch.x(k)) + 0.5f, place.y = static_cast<float>(patch.y(k)) + 0.5f;
        if (!patch.inside(k)) return;
        const BlendArgs& a = patch.args;
        const int64_t pixel = patch.pixel(k);
        place.stop = reinterpret_cast<const int32_t*>(picture.stop)[pixel];
        behind.T = picture.transmittance[pixel];
        if (grads.alpha && patch.first_channel == 0) place.alpha = grads.alpha[pixel];
        for (int c = 0; c < patch.count; ++c) {
            color.of[c] = grads.image[pixel * a.D + patch.first_channel + c];
            behind.seen += color.of[c] * a.background[patch.first_channel + c];
        }
    }
};

// Returns the largest `stop` of the warp's pixels: the position in the tile's list at which the last of them ended.
__device__ inline int last_stop(int stop) {
    for (int offset = WARP / 2; offset > 0; offset /= 2) {
        const int other = __shfl_xor_sync(ALL_LANES, stop, offset);
        stop = other > stop ? other : stop;
    }
    return stop;
}

// Removes a splat that was blended from the pixel's state, and adds to the splat's sums: moments, then colours.
template <class Profile>
__device__ void unblend(const Falloff<float, Profile>& f, const float (&color)[CHANNELS], const Place& place,
                        const ColorGrad& grad, Behind& behind, float (&sums)[Patch<Profile>::SUMS]) {
    constexpr int GEOMETRY = Profile::MOMENTS;
    behind.T = __fdividef(behind.T, 1.0f - f.alpha);  // which is at least 1/1000
    const float weight = f.alpha * behind.T;
    float own = place.alpha;  // the splat's own colour and cover, times the gradient
    for (int c = 0; c < CHANNELS; ++c) {
        own += grad.of[c] * color[c];
        sums[GEOMETRY + c] += weight * grad.of[c];
    }
    const float difference = own - behind.seen;
    behind.seen += f.alpha * difference;
    if (f.free > ALPHA_MAX) return;
    FalloffMoments<float, Profile> m;
    for (int k = 0; k < GEOMETRY; ++k) m.of[k] = sums[k];
    m.add(f, weight * difference);
    for (int k = 0; k < GEOMETRY; ++k) sums[k] = m.of[k];
}

// Returns the address at which sum `column` of a splat is accumulated, for a launch that blends channels from
// `first_channel` on.
template <class Profile>
__device__ float* sum_of(const BlendGrads& out, const Patch<Profile>& patch, int32_t id, int column) {
    const int at = column < Profile::MOMENTS ? column : column + patch.first_channel;
    return out.scratch + static_cast<int64_t>(id) * (Profile::MOMENTS + patch.args.D) + at;
}

// The two kernels have the same arguments.
using SumUp = void(const BlendArgs&, const BlendState&, const PictureGrads&, const BlendGrads&, int first_channel,
                   Stream);
SumUp sum_by_pixel, sum_by_splat;

}  // namespace gsb::cuda
