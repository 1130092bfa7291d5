// Looks whether the rasterizer's numbers are finite and in range, in one pass; math/values.h says what the ranges are.
#include "../math/values.h"

#include "isa.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int64_t MANY = 1 << 17;  // numbers that are worth a second thread

bool good(const Range& r, int threads) {
    int bad = 0;
    if (r.stride == 1) {
#pragma omp parallel for simd num_threads(threads) schedule(static) reduction(| : bad) if (r.count > MANY)
        for (int64_t i = 0; i < r.count; ++i) bad |= !(r.values[i] >= r.low) | !(r.values[i] <= r.high);  // true of NaN
    } else {
        for (int64_t i = 0; i < r.count; ++i) {
            const float x = r.values[i * r.stride];
            bad |= !(x >= r.low) | !(x <= r.high);
        }
    }
    return !bad;
}

}  // namespace

void flag_values(const ValueArgs& a, const ValueFlags& out) {
    for (const Range& range : ranges_of(a).range) {
        if (!good(range, a.threads)) *out.flags |= int64_t{1} << range.bit;
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
