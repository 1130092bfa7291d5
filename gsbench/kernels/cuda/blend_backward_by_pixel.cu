// The gradients of blending with one lane per pixel: a splat's sums over the patch are reduced across the lanes and
// added to its row by one atomic instruction in nine lanes, or ten.
#include "blend_backward.h"

namespace gsb::cuda {
namespace {

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
    auto [place, grad, behind] = BackwardPixel(patch, patch.lane, picture, grads);
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

}  // namespace

void sum_by_pixel(const BlendArgs& a, const BlendState& picture, const PictureGrads& grads, const BlendGrads& out,
                  int first_channel, Stream stream) {
    launch(a.shapes ? by_pixel_kernel<Beta> : by_pixel_kernel<Gaussian>, tiles_of(a), PATCHES * WARP, stream, a,
           picture, grads, out, first_channel);
}

}  // namespace gsb::cuda
