// Adam on several parameters in one launch, some numbers of each parameter per thread; math/adam.h has the formulas.
#include "../math/adam.h"

#include <cmath>

#include "launch.h"

namespace gsb::cuda {
namespace {

__global__ void count_kernel(const __grid_constant__ AdamArgs a, const __grid_constant__ AdamState state) {
    if (a.skip && *a.skip != 0.0f) return;
    if (threadIdx.x < a.count) *state.steps[threadIdx.x] += 1.0f;
}

__global__ void adam_kernel(const __grid_constant__ AdamArgs a, const __grid_constant__ AdamState state,
                            float log_beta1, float log_beta2) {
    if (a.skip && *a.skip != 0.0f) return;
    const int64_t threads = static_cast<int64_t>(gridDim.x) * blockDim.x;
    for (int i = 0; i < a.count; ++i) {
        if (global_thread() >= a.numbers[i]) continue;
        // 1 - beta^step, accurate if beta^step is near 1.
        const float left1 = -expm1f(*state.steps[i] * log_beta1), left2 = -expm1f(*state.steps[i] * log_beta2);
        const auto f = [](double x) { return static_cast<float>(x); };
        const AdamRule rule{*a.rates[i], f(a.beta1), f(a.beta2), f(a.eps), 1.0f / left1, 1.0f / sqrtf(left2)};
        for (int64_t k = global_thread(); k < a.numbers[i]; k += threads) {
            if (a.drawn[i] && !a.drawn[i][k / a.widths[i]]) continue;
            float p = state.parameters[i][k], m = state.means[i][k], v = state.squares[i][k];  // loaded at once
            adam_update(rule, a.gradients[i][k], p, m, v);
            state.parameters[i][k] = p, state.means[i][k] = m, state.squares[i][k] = v;
        }
    }
}

}  // namespace

void adam_all(const AdamArgs& a, const AdamState& state, Stream stream) {
    launch(count_kernel, 1, MAX_ADAM, stream, a, state);  // first, as every block reads the numbers of updates
    launch(adam_kernel, looping_blocks(largest(a.numbers)), THREADS, stream, a, state,
           static_cast<float>(std::log(a.beta1)), static_cast<float>(std::log(a.beta2)));
}

}  // namespace gsb::cuda
