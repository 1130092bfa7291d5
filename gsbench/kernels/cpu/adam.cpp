// Adam on several parameters: on all their rows, or on the selected ones, without reading or writing the others.
#include "../math/adam.h"

#include "isa.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int64_t CHUNK = 256;     // rows a thread takes at a time
constexpr int64_t MANY = 1 << 16;  // numbers that are worth a second thread

AdamRule rule_of(float rate, double beta1, double beta2, double eps, double step) {
    const auto f = [](double x) { return static_cast<float>(x); };
    const double left1 = 1.0 - ::pow(beta1, step), left2 = 1.0 - ::pow(beta2, step);
    return {rate, f(beta1), f(beta2), f(eps), f(1.0 / left1), f(1.0 / ::sqrt(left2))};
}

}  // namespace

void adam_all(const AdamArgs& a, const AdamState& state) {
    if (a.skip && *a.skip != 0.0f) return;
    int64_t total = 0;
    for (int i = 0; i < a.count; ++i) total += a.numbers[i], *state.steps[i] += 1.0f;
#pragma omp parallel num_threads(a.threads) if (total > MANY)
    for (int i = 0; i < a.count; ++i) {
        const AdamRule rule = rule_of(*a.rates[i], a.beta1, a.beta2, a.eps, *state.steps[i]);
        const float* g = a.gradients[i];
        float *p = state.parameters[i], *m = state.means[i], *v = state.squares[i];
        if (!a.drawn[i]) {
#pragma omp for simd schedule(static) nowait
            for (int64_t k = 0; k < a.numbers[i]; ++k) adam_update(rule, g[k], p[k], m[k], v[k]);
            continue;
        }
        const int64_t width = a.widths[i], N = width ? a.numbers[i] / width : 0;
#pragma omp for schedule(static) nowait
        for (int64_t chunk = 0; chunk < N; chunk += CHUNK) {
            const int64_t end = chunk + CHUNK < N ? chunk + CHUNK : N;
            for (int64_t row = chunk; row < end;) {
                if (!a.drawn[i][row]) {
                    ++row;
                    continue;
                }
                const int64_t first = row * width;  // neighbours that are drawn too go as one run
                while (row < end && a.drawn[i][row]) ++row;
#pragma omp simd
                for (int64_t k = first; k < row * width; ++k) adam_update(rule, g[k], p[k], m[k], v[k]);
            }
        }
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
