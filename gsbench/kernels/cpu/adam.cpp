// Adam on some rows of a parameter: those that are not drawn are neither read nor written.
#include "../math/adam.h"

#include "isa.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int64_t CHUNK = 256;  // rows a thread takes at a time

}  // namespace

void adam(const AdamArgs& a, const AdamState& state) {
    const double left1 = 1.0 - ::pow(a.beta1, *a.step), left2 = 1.0 - ::pow(a.beta2, *a.step);
    const auto f = [](double x) { return static_cast<float>(x); };
    const AdamRule rule{f(a.rate), f(a.beta1), f(a.beta2), f(a.eps), f(1.0 / left1), f(1.0 / ::sqrt(left2))};
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N > CHUNK)
    for (int64_t chunk = 0; chunk < a.N; chunk += CHUNK) {
        const int64_t end = chunk + CHUNK < a.N ? chunk + CHUNK : a.N;
        for (int64_t row = chunk; row < end;) {
            if (!a.drawn[row]) {
                ++row;
                continue;
            }
            const int64_t first = row * a.width;  // neighbours that are drawn too go as one run
            while (row < end && a.drawn[row]) ++row;
#pragma omp simd
            for (int64_t k = first; k < row * a.width; ++k) {
                adam_update(rule, a.gradient[k], state.parameter[k], state.mean[k], state.square[k]);
            }
        }
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
