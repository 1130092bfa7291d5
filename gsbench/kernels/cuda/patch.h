// Shared code of blending, forward and backward: a warp's patch of 8 x 4 pixels, and the projected Gaussians (splats)
// that reach it, staged in shared memory.
//
// A tile has 8 patches, one per warp, and warps do not wait for each other. A warp reads the tile's list 32 splats at a
// time, one per lane, tests them against its patch and keeps those that reach it. Most splats of a tile do not reach a
// given patch, so this cheap test saves most evaluations of alpha.
#pragma once

#include "../math/blending.h"

#include "launch.h"

namespace gsb::cuda {

constexpr int PATCH_X = 8, PATCH_Y = 4;
constexpr int PATCHES = TILE * TILE / (PATCH_X * PATCH_Y);
constexpr int CHANNELS = 3;  // blended at once; pictures of more are blended three channels at a time

constexpr float POWER_MARGIN = 0.01f;  // added to log2(255 opacity), so that rounding cuts off no pixel; far above the
                                       // errors of the fast division and logarithm

// Tests whether a projected Gaussian has alpha >= 1/255 anywhere in a rectangle of pixels; exact up to a rounding
// margin.
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

struct alignas(16) StagedSplat {
    float x, y, p, q, r, opacity;
    int32_t id, position;  // among all splats; in the tile's list
    float color[CHANNELS];
    float shape;  // of a Beta profile
};

inline unsigned tiles_of(const BlendArgs& a) {
    return static_cast<unsigned>(a.C * tiles_along(a.width) * tiles_along(a.height));
}

template <class Profile>
struct Patch {
    static constexpr int GEOMETRY = Profile::MOMENTS, SUMS = GEOMETRY + CHANNELS;  // sums over pixels for a splat

    const BlendArgs& args;
    int64_t camera;
    int lane, left, top;       // pixels
    int begin, size;           // the tile's list
    int first_channel, count;  // what this launch blends

    __device__ Patch(const BlendArgs& a, int first_channel)
        : args(a), lane(static_cast<int>(threadIdx.x) % WARP), first_channel(first_channel),
          count(a.D - first_channel < CHANNELS ? a.D - first_channel : CHANNELS) {
        const int across = tiles_along(a.width), tiles = across * tiles_along(a.height);
        const int tile = static_cast<int>(blockIdx.x), patch = static_cast<int>(threadIdx.x) / WARP;
        camera = tile / tiles;
        left = tile % tiles % across * TILE + patch % (TILE / PATCH_X) * PATCH_X;
        top = tile % tiles / across * TILE + patch / (TILE / PATCH_X) * PATCH_Y;
        begin = a.offsets[tile];
        size = a.offsets[tile + 1] - begin;
    }

    // The position of pixel number k, whether it is inside the image, and its index in the image arrays.
    __device__ int x(int k) const { return left + k % PATCH_X; }
    __device__ int y(int k) const { return top + k / PATCH_X; }
    __device__ bool inside(int k) const { return x(k) < args.width && y(k) < args.height; }
    __device__ int64_t pixel(int k) const { return (camera * args.height + y(k)) * args.width + x(k); }

    // Loads the splat at a position of the tile's list, without its colour.
    __device__ StagedSplat splat_at(int position) const {
        StagedSplat s{};
        s.id = args.ids[begin + position];
        s.position = position;
        const float2 mean = reinterpret_cast<const float2*>(args.means2d)[s.id];
        const float4 root = reinterpret_cast<const float4*>(args.roots)[s.id];
        s.x = mean.x, s.y = mean.y;
        s.p = root.x, s.q = root.y, s.r = root.z, s.opacity = root.w;
        if constexpr (Profile::HAS_SHAPE) s.shape = args.shapes[args.shape_per_camera ? s.id : s.id - camera * args.N];
        return s;
    }

    __device__ bool is_reached_by(const StagedSplat& s) const {
        const float* half_sizes = args.half_sizes + static_cast<int64_t>(s.id) * 2;
        const Reach reach = reach_of<Profile>({s.x, s.y}, {s.p, s.q, s.r, s.opacity}, half_sizes);
        return reach.touches(left, top, PATCH_X, PATCH_Y);
    }

    __device__ void load_color(StagedSplat& s) const {
        const int64_t row = args.color_per_camera ? s.id : s.id - camera * args.N;
        const float* color = args.colors + row * args.D + first_channel;
        for (int k = 0; k < CHANNELS; ++k) s.color[k] = k < count ? color[k] : 0.0f;
    }

    // Stages the splats at positions [first, first + 32) of the list that reach the patch, in order. Returns their
    // number.
    __device__ int stage(int first, StagedSplat* staged) const {
        const int position = first + lane;
        bool reached = false;
        StagedSplat s;
        if (position < size) {
            s = splat_at(position);
            reached = is_reached_by(s);
        }
        const unsigned all = __ballot_sync(ALL_LANES, reached);
        if (reached) {
            load_color(s);
            staged[__popc(all & ((1u << lane) - 1))] = s;
        }
        __syncwarp();
        return __popc(all);
    }
};

}  // namespace gsb::cuda
