// Tests whether a projected Gaussian has alpha >= 1/255 anywhere in a rectangle of pixels; exact up to a rounding
// margin.
#pragma once

#include "launch.h"

namespace gsb::cuda {

constexpr float POWER_MARGIN = 0.01f;  // added to log2(255 opacity), so that rounding cuts off no pixel; far above the
                                       // errors of the fast division and logarithm

struct Reach {
    float x, y, p, q, r, foot_x, foot_y, most_power;

    __device__ Reach(float2 mean, float4 root, float most_power)
        : x(mean.x), y(mean.y), p(root.x), q(root.y), r(root.z), most_power(most_power) {
        foot_y = __fdividef(-q, r);
        foot_x = __fdividef(-q * r, p * p + q * q);
    }

    // Tests the centres of the pixels [left, left + width) x [top, top + height).
    __device__ bool touches(int left, int top, int width, int height) const {
        const float x0 = static_cast<float>(left) + 0.5f - x, y0 = static_cast<float>(top) + 0.5f - y;
        return least_power(x0, x0 + static_cast<float>(width - 1), y0, y0 + static_cast<float>(height - 1), p, q, r,
                           foot_x, foot_y) <= most_power;
    }
};

// Returns the reach of a splat with this profile. That of a Beta profile is in its half width, which has a margin.
template <class Profile>
__device__ Reach reach_of(float2 mean, float4 root, const float* half_sizes) {
    if constexpr (Profile::HAS_SHAPE) {
        const float reach = half_sizes[0] * root.x;
        return {mean, root, reach * reach};
    } else {
        return {mean, root, __log2f(255.0f * root.w) + POWER_MARGIN};
    }
}

}  // namespace gsb::cuda
