// Adds up what density control needs of a view, one Gaussian per thread.
#include <cmath>

#include "launch.h"

namespace gsb::cuda {
namespace {

__global__ void density_kernel(DensityArgs a, DensityState state) {
    const int64_t i = global_thread();
    if (i >= a.N || *a.skip != 0.0f) return;
    float gradient = 0.0f;
    int drawn = 0;
    for (int64_t c = 0; c < a.C; ++c) {
        const int64_t k = c * a.N + i;
        gradient += hypotf(a.g_means2d[2 * k] * a.scale_x, a.g_means2d[2 * k + 1] * a.scale_y);
        drawn += a.drawn[k];
    }
    state.gradient[i] += gradient;
    state.times_visible[i] += static_cast<float>(drawn);
    if (state.unseen) state.unseen[i] = drawn ? 0 : state.unseen[i] + static_cast<int32_t>(a.C);
}

}  // namespace

void add_density(const DensityArgs& a, const DensityState& state, Stream stream) {
    if (a.N == 0) return;
    launch(density_kernel, blocks_for(a.N), THREADS, stream, a, state);
}

}  // namespace gsb::cuda
