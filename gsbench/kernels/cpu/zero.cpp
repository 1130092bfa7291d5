// Sets arrays to zero: gradients, before kernels add to them.
#include "isa.h"
#include "rows.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int64_t PART = 1 << 16;  // numbers that are worth a second thread

}  // namespace

void zero_arrays(const ZeroArgs& a) {
    int64_t total = 0;
    for (int i = 0; i < a.count; ++i) total += a.numbers[i];
#pragma omp parallel num_threads(a.threads) if (total > PART)
    for (int i = 0; i < a.count; ++i) {
#pragma omp for schedule(static) nowait
        for (int64_t first = 0; first < a.numbers[i]; first += PART) {
            const int64_t end = first + PART < a.numbers[i] ? first + PART : a.numbers[i];
            zero_rows(a.arrays[i], 1, first, end, total);
        }
        finish_zeros();
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
