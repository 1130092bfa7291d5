// The derivative of blending, back to front: what its two kernels share. Both give a warp a patch of pixels and leave
// sums over pixels for each splat; they differ in what a lane holds, a pixel or a splat.
#pragma once

#include "patch.h"

namespace gsb::cuda {

constexpr int GEOMETRY = 6;
constexpr int SUMS = GEOMETRY + CHANNELS;

// A pixel of the picture: where, how much of the tile's list it blended, the gradients of the loss by its alpha and by
// its colour. Two arrays of four numbers each, so that lanes that read 32 of them meet in no bank of shared memory.
struct alignas(16) Place {
    float x, y;
    int stop;
    float alpha;
};
struct alignas(16) ColorGrad {
    float of[CHANNELS];
};

// What changes at a pixel from splat to splat: the transmittance before those already seen, and what they show of
// themselves, times the pixel's gradient. At first the background, whose alpha is zero.
struct Behind {
    float T, seen;
};

struct BackwardPixel {
    Place place{};
    ColorGrad color{};
    Behind behind{1.0f, 0.0f};

    // Pixel number `k` of the patch; outside the picture nothing was blended.
    __device__ BackwardPixel(const Patch& patch, int k, const BlendState& picture, const PictureGrads& grads) {
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

// The place in the tile's list where the last of the patch's pixels stopped.
__device__ inline int last_stop(int stop) {
    for (int offset = WARP / 2; offset > 0; offset /= 2) {
        const int other = __shfl_xor_sync(ALL_LANES, stop, offset);
        stop = other > stop ? other : stop;
    }
    return stop;
}

// Takes a splat that was blended off the pixel again, and adds to the splat's sums: moments, then colours.
__device__ inline void unblend(const Falloff<float>& f, const float (&color)[CHANNELS], const Place& place,
                               const ColorGrad& grad, Behind& behind, float (&sums)[SUMS]) {
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
    FalloffMoments<float> m{sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]};
    m.add(f, weight * difference);
    sums[0] = m.v, sums[1] = m.u, sums[2] = m.w, sums[3] = m.w_dx, sums[4] = m.u_dx, sums[5] = m.u_dy;
}

// Where sum `column` of a splat is added up, for a launch that blends channels from `first_channel` on.
__device__ inline float* sum_of(const BlendGrads& out, const Patch& patch, int32_t id, int column) {
    const int at = column < GEOMETRY ? column : column + patch.first_channel;
    return out.scratch + static_cast<int64_t>(id) * (GEOMETRY + patch.args.D) + at;
}

// One kernel for each, with the same arguments.
using SumUp = void(const BlendArgs&, const BlendState&, const PictureGrads&, const BlendGrads&, int first_channel,
                   Stream);
SumUp sum_by_pixel, sum_by_splat;

}  // namespace gsb::cuda
