// The gradients of blending with one lane per projected Gaussian (splat), which keeps its sums in registers, so that
// nothing is reduced across lanes.
//
// The 32 pixels of a patch move along the lanes of the warp, with the splats back to front: pixel p meets splat i in
// step p + i, in lane i % 32. After the first steps every lane works in every step, and lane i takes its next splat
// when the last pixel has passed.
#include "blend_backward.h"

namespace gsb::cuda {
namespace {

// The shared memory of a warp.
struct Traffic {
    Place places[WARP];
    ColorGrad colors[WARP];
    int waiting[2 * WARP];  // positions of splats that reach the patch, back to front: a ring
    alignas(16) float sums[WARP][12];  // of splats that all pixels have passed; nine or ten of twelve, to be aligned
    int32_t ids[WARP];                 // theirs; -1: none
};

// Returns a splat with alpha zero, for a lane that has none.
__device__ StagedSplat nobody() {
    StagedSplat s{};
    s.id = -1;
    return s;
}

// Reads the list backwards and queues splats that reach the patch, until there is one for every lane or the list ends;
// `end` is the end of its unread part.
template <class Profile>
__device__ void let_wait(const Patch<Profile>& patch, int* waiting, int first, int& count, int& end) {
    while (count < WARP && end > 0) {
        const int position = end - 1 - patch.lane;
        const bool reached = position >= 0 && patch.is_reached_by(patch.splat_at(position));
        const unsigned all = __ballot_sync(ALL_LANES, reached);
        if (reached) {
            const int place = first + count + __popc(all & ((1u << patch.lane) - 1));
            waiting[place % (2 * WARP)] = position;
        }
        count += __popc(all);
        end -= WARP;
    }
    __syncwarp();
}

template <class Profile>
__global__ void __launch_bounds__(PATCHES * WARP)
    by_splat_kernel(BlendArgs a, BlendState picture, PictureGrads grads, BlendGrads out, int first_channel) {
    __shared__ Traffic shared[PATCHES];
    Traffic& traffic = shared[threadIdx.x / WARP];
    constexpr int GEOMETRY = Profile::MOMENTS, SUMS = Patch<Profile>::SUMS;
    const Patch<Profile> patch(a, first_channel);
    // Lane l starts with the pixel that reaches lane 0 after 32 - l steps.
    const int mine = (WARP - patch.lane) % WARP;
    const BackwardPixel start(patch, mine, picture, grads);
    traffic.places[mine] = start.place;
    traffic.colors[mine] = start.color;
    Behind behind = start.behind;
    int first = 0, count = 0, end = last_stop(start.place.stop);  // of the ring; of the list
    if (end == 0) return;
    StagedSplat host = nobody();
    float sums[SUMS] = {};
    const int source = (patch.lane + WARP - 1) % WARP;
    for (int before = 0, n = WARP; n > 0;) {
        let_wait(patch, traffic.waiting, first, count, end);
        before = n, n = count < WARP ? count : WARP;
        StagedSplat next = nobody();
        if (patch.lane < n) {
            next = patch.splat_at(traffic.waiting[(first + patch.lane) % (2 * WARP)]);
            patch.load_color(next);
        }
        first += n, count -= n;
        const int steps = n > 0 ? WARP : before;  // at last, until the pixels have passed the splats before
        for (int step = 0; step < steps; ++step) {
            if (patch.lane == step) {
                for (int k = 0; k < SUMS; ++k) traffic.sums[step][k] = sums[k], sums[k] = 0.0f;
                traffic.ids[step] = host.id;
                host = next;
            }
            const int pixel = (step - patch.lane) & (WARP - 1);
            const Place place = traffic.places[pixel];
            const Falloff<float, Profile> f(place.x - host.x, place.y - host.y, host);
            if (host.position < place.stop && f.alpha >= ALPHA_MIN) {
                unblend(f, host.color, place, traffic.colors[pixel], behind, sums);
            }
            behind = {__shfl_sync(ALL_LANES, behind.T, source), __shfl_sync(ALL_LANES, behind.seen, source)};
        }
        __syncwarp();
        for (int k = patch.lane; k < steps * SUMS; k += WARP) {
            const int row = k / SUMS, column = k % SUMS;
            if (traffic.ids[row] < 0 || column >= GEOMETRY + patch.count) continue;
            atomicAdd(sum_of(out, patch, traffic.ids[row], column), traffic.sums[row][column]);
        }
        __syncwarp();
    }
}

}  // namespace

void sum_by_splat(const BlendArgs& a, const BlendState& picture, const PictureGrads& grads, const BlendGrads& out,
                  int first_channel, Stream stream) {
    launch(a.shapes ? by_splat_kernel<Beta> : by_splat_kernel<Gaussian>, tiles_of(a), PATCHES * WARP, stream, a,
           picture, grads, out, first_channel);
}

}  // namespace gsb::cuda
