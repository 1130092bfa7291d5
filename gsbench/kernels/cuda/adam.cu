// Adam on the selected rows of a parameter, one number per thread; math/adam.h has the formulas.
#include "../math/adam.h"

#include <cmath>

#include "launch.h"

namespace gsb::cuda {
namespace {

__global__ void adam_kernel(AdamArgs a, AdamState state, AdamRule rule, float log_beta1, float log_beta2) {
    const int64_t k = global_thread();
    if (k >= a.N * a.width || !a.drawn[k / a.width]) return;
    // 1 - beta^step, accurate if beta^step is near 1. The step is read on the device, so that the CPU does not wait for
    // it.
    const float left1 = -expm1f(*a.step * log_beta1), left2 = -expm1f(*a.step * log_beta2);
    rule.unbias1 = 1.0f / left1, rule.unbias2 = 1.0f / sqrtf(left2);
    adam_update(rule, a.gradient[k], state.parameter[k], state.mean[k], state.square[k]);
}

}  // namespace

void adam(const AdamArgs& a, const AdamState& state, Stream stream) {
    if (a.N * a.width == 0) return;
    const auto f = [](double x) { return static_cast<float>(x); };
    const AdamRule rule{f(a.rate), f(a.beta1), f(a.beta2), f(a.eps), 0.0f, 0.0f};  // the step's are the kernel's
    launch(adam_kernel, blocks_for(a.N * a.width), THREADS, stream, a, state, rule, f(std::log(a.beta1)),
           f(std::log(a.beta2)));
}

}  // namespace gsb::cuda
