// Adam on the rows of a parameter that were drawn, a number a thread; the mathematics is math/adam.h.
#include "../math/adam.h"

#include "launch.h"

namespace gsb::cuda {
namespace {

__global__ void adam_kernel(AdamArgs a) {
    const int64_t k = global_thread();
    if (k >= a.N * a.width || !a.drawn[k / a.width]) return;
    // 1 - beta^step, exact where beta^step is near 1; the step stays on the device, where nothing waits for it.
    const float left1 = -expm1f(*a.step * a.log_beta1), left2 = -expm1f(*a.step * a.log_beta2);
    const AdamRule rule{a.rate, a.beta1, a.beta2, a.eps, 1.0f / left1, 1.0f / sqrtf(left2)};
    adam_update(rule, a.gradients[k], a.parameters[k], a.means[k], a.squares[k]);
}

}  // namespace

void adam(const AdamArgs& a, Stream stream) {
    if (a.N > 0) launch(adam_kernel, blocks_for(a.N * a.width), THREADS, stream, a);
}

}  // namespace gsb::cuda
