// The derivative of blending: back to front, a warp a patch, a pixel a lane. A splat's sums over the patch are reduced
// across the lanes and added to its row with one atomic instruction of nine lanes.
#include "patch.h"

namespace gsb::cuda {
namespace {

constexpr int GEOMETRY = 6;
constexpr int SUMS = GEOMETRY + CHANNELS;

// The sum over the warp of nine values, lane l holding that of value `value_of(l)`. Eight of them are summed at once, each
// step of the butterfly halving how many a lane is responsible for: 9 shuffles instead of 40, and 5 for the ninth.
struct NineSums {
    static __device__ int value_of(int lane) { return lane % 4 == 0 ? lane / 4 : lane == 1 ? SUMS - 1 : -1; }

    static __device__ float reduce(float (&v)[SUMS], int lane) {
        halve<4>(v, lane, 16);
        halve<2>(v, lane, 8);
        halve<1>(v, lane, 4);
        v[0] += __shfl_xor_sync(ALL_LANES, v[0], 2);
        v[0] += __shfl_xor_sync(ALL_LANES, v[0], 1);
        const float last = warp_sum(v[SUMS - 1]);
        return lane == 1 ? last : v[0];
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
static_assert(SUMS == 9);

__global__ void __launch_bounds__(PATCHES * WARP)
    blend_backward_kernel(BlendArgs a, Picture picture, BlendGrads grads, int first_channel) {
    __shared__ StagedSplat shared[PATCHES][WARP];
    StagedSplat* staged = shared[threadIdx.x / WARP];
    const Patch patch(a, first_channel);
    const float x = static_cast<float>(patch.x()) + 0.5f, y = static_cast<float>(patch.y()) + 0.5f;
    const bool inside = patch.inside();
    const int64_t pixel = inside ? patch.pixel() : 0;
    const int stop = inside ? picture.stop[pixel] : 0;
    float T = inside ? picture.transmittance[pixel] : 1.0f;
    float g_color[CHANNELS] = {};
    // What is seen behind the splat at hand, times the pixel's gradient: first the background, whose alpha is zero.
    float behind = 0.0f, g_alpha = 0.0f;
    if (inside && grads.image) {
        for (int k = 0; k < patch.count; ++k) {
            g_color[k] = grads.image[pixel * a.D + first_channel + k];
            behind += g_color[k] * a.background[first_channel + k];
        }
    }
    if (inside && grads.alpha && first_channel == 0) g_alpha = grads.alpha[pixel];

    int last = stop;
    for (int offset = WARP / 2; offset > 0; offset /= 2) {
        const int other = __shfl_xor_sync(ALL_LANES, last, offset);
        last = other > last ? other : last;
    }
    const int my_value = NineSums::value_of(patch.lane);
    const int my_column = my_value < GEOMETRY ? my_value : my_value + first_channel;
    const bool writes = my_value >= 0 && my_value < GEOMETRY + patch.count;
    for (int first = (last + WARP - 1) / WARP * WARP - WARP; first >= 0; first -= WARP) {
        for (int i = patch.stage(first, staged) - 1; i >= 0; --i) {
            const StagedSplat& s = staged[i];
            const Falloff<float> f(x - s.x, y - s.y, s.p, s.q, s.r, s.opacity);
            const bool blended = s.position < stop && f.alpha >= ALPHA_MIN;
            if (!__any_sync(ALL_LANES, blended)) continue;
            float v[SUMS] = {};
            if (blended) {
                T = T / (1.0f - f.alpha);
                const float weight = f.alpha * T;
                float seen = g_alpha;  // the splat's own colour and cover, times the gradient
                for (int k = 0; k < CHANNELS; ++k) {
                    seen += g_color[k] * s.color[k];
                    v[GEOMETRY + k] = weight * g_color[k];
                }
                const float difference = seen - behind;
                behind += f.alpha * difference;
                if (f.free <= ALPHA_MAX) {
                    FalloffMoments<float> m{};
                    m.add(f, weight * difference);
                    v[0] = m.v, v[1] = m.u, v[2] = m.w, v[3] = m.w_dx, v[4] = m.u_dx, v[5] = m.u_dy;
                }
            }
            const float sum = NineSums::reduce(v, patch.lane);
            if (writes) atomicAdd(grads.sums + static_cast<int64_t>(s.id) * (GEOMETRY + a.D) + my_column, sum);
        }
        __syncwarp();
    }
}

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

void blend_backward(const BlendArgs& a, const Picture& picture, const BlendGrads& grads, Stream stream) {
    if (a.N == 0) return;
    const auto tiles = static_cast<unsigned>(a.C * tiles_along(a.width) * tiles_along(a.height));
    for (int first = 0; first < a.D; first += CHANNELS) {
        launch(blend_backward_kernel, tiles, PATCHES * WARP, stream, a, picture, grads, first);
    }
    launch(finish_kernel, blocks_for(a.N), THREADS, stream, a, grads);
}

}  // namespace gsb::cuda
