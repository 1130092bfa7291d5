// The gradients of blending: sums over pixels, back to front, then the gradients of each projected Gaussian (splat) from
// its sums, and the gradient of the background.
//
// A warp processes a patch of 8 x 4 pixels, one in a lane. A splat's sums over the patch are reduced across the lanes
// and added to its row by one atomic instruction in nine lanes, or ten.
#include "patch.h"

namespace gsb::cuda {
namespace {

// A pixel of the image: its position, how many splats of the tile's list it blended, and the gradients of the loss by
// its alpha and its colour.
struct Place {
    float x, y;
    int stop;
    float alpha;
};
struct ColorGrad {
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

    // Loads the pixel of a lane; outside of the image nothing was blended.
    template <class Profile>
    __device__ BackwardPixel(const Patch<Profile>& patch, const BlendState& picture, const PictureGrads& grads) {
        const int k = patch.lane;
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
__device__ int last_stop(int stop) {
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

// The sums over the warp of nine values, or ten; lane l gets the sum of value `value_of(l)`. Eight values are reduced
// together, and each step of the butterfly halves the number of values in a lane. This takes 9 shuffles instead of 40,
// and 5 for each further value.
template <int SUMS>
struct WarpSums {
    static constexpr int TOGETHER = 8;
    static_assert(SUMS > TOGETHER && SUMS <= TOGETHER + 3);

    static __device__ int value_of(int lane) {
        return lane % 4 == 0 ? lane / 4 : lane <= SUMS - TOGETHER ? TOGETHER + lane - 1 : -1;
    }

    static __device__ float reduce(float (&v)[SUMS], int lane) {
        halve<4>(v, lane, 16);
        halve<2>(v, lane, 8);
        halve<1>(v, lane, 4);
        v[0] += __shfl_xor_sync(ALL_LANES, v[0], 2);
        v[0] += __shfl_xor_sync(ALL_LANES, v[0], 1);
        float mine = v[0];
        for (int i = TOGETHER; i < SUMS; ++i) {
            const float sum = warp_sum(v[i]);
            if (lane == i - TOGETHER + 1) mine = sum;
        }
        return mine;
    }

  private:
    template <int N>
    static __device__ void halve(float (&v)[SUMS], int lane, int offset) {
        const bool upper = (lane & offset) != 0;
        for (int i = 0; i < N; ++i) {
            const float mine = upper ? v[i + N] : v[i], other = upper ? v[i] : v[i + N];
            v[i] = mine + __shfl_xor_sync(ALL_LANES, other, offset);
        }
    }
};

template <class Profile>
__global__ void __launch_bounds__(PATCHES * WARP)
    by_pixel_kernel(BlendArgs a, BlendState picture, PictureGrads grads, BlendGrads out, int first_channel) {
    __shared__ StagedSplat shared[PATCHES][WARP];
    StagedSplat* staged = shared[threadIdx.x / WARP];
    using P = Patch<Profile>;
    using Sums = WarpSums<P::SUMS>;
    const P patch(a, first_channel);
    auto [place, grad, behind] = BackwardPixel(patch, picture, grads);
    const int my_value = Sums::value_of(patch.lane);
    const bool writes = my_value >= 0 && my_value < P::GEOMETRY + patch.count;
    for (int first = (last_stop(place.stop) + WARP - 1) / WARP * WARP - WARP; first >= 0; first -= WARP) {
        for (int i = patch.stage(first, staged) - 1; i >= 0; --i) {
            const StagedSplat& s = staged[i];
            const Falloff<float, Profile> f(place.x - s.x, place.y - s.y, s);
            const bool blended = s.position < place.stop && f.alpha >= ALPHA_MIN;
            if (!__any_sync(ALL_LANES, blended)) continue;
            float sums[P::SUMS] = {};
            if (blended) unblend(f, s.color, place, grad, behind, sums);
            const float sum = Sums::reduce(sums, patch.lane);
            if (writes) atomicAdd(sum_of(out, patch, s.id, my_value), sum);
        }
        __syncwarp();
    }
}

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

}  // namespace

void blend_backward(const BlendArgs& a, const BlendState& picture, const PictureGrads& grads, const BlendGrads& out,
                    Stream stream) {
    constexpr unsigned MOST_BLOCKS = 256;  // their warps wait for each other to add to the background's few numbers
    const unsigned blocks = blocks_for(a.C * a.height * a.width);
    const auto kernel = a.shapes ? by_pixel_kernel<Beta> : by_pixel_kernel<Gaussian>;
    for (int first = 0; first < a.D; first += CHANNELS) {
        if (a.N > 0) launch(kernel, tiles_of(a), PATCHES * WARP, stream, a, picture, grads, out, first);
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

}  // namespace gsb::cuda
