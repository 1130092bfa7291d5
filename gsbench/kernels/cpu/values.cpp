// Checks in one pass whether the rasterizer's inputs are finite and in range, or whether gradients are finite;
// math/values.h has the ranges.
#include "../math/values.h"

#include "isa.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int64_t PART = 1 << 17;  // numbers that are worth a second thread

// Returns a nonzero value if one of `count` numbers is not in [low, high]. Inside a parallel region GCC 12 does not
// vectorise this loop.
int any_outside(const float* x, int64_t count, float low, float high) {
    int bad = 0;
#pragma omp simd reduction(| : bad)
    for (int64_t i = 0; i < count; ++i) bad |= !(x[i] >= low) | !(x[i] <= high);  // true of NaN
    return bad;
}

bool good(const Range& r, int threads) {
    int bad = 0;
    if (r.stride == 1) {
        const int64_t parts = (r.count + PART - 1) / PART;
#pragma omp parallel for num_threads(threads) schedule(static) reduction(| : bad) if (parts > 1)
        for (int64_t p = 0; p < parts; ++p) {
            const int64_t first = p * PART, left = r.count - first;
            bad |= any_outside(r.values + first, left < PART ? left : PART, r.low, r.high);
        }
    } else {
        for (int64_t i = 0; i < r.count; ++i) bad |= any_outside(r.values + i * r.stride, 1, r.low, r.high);
    }
    return !bad;
}

}  // namespace

void flag_values(const ValueArgs& a, const ValueFlags& out) {
    for (const Range& range : ranges_of(a).range) {
        if (!good(range, a.threads)) *out.flags |= int64_t{1} << range.bit;
    }
}

void flag_arrays(const FiniteArgs& a, const ArrayFlags& out) {
    for (int i = 0; i < a.count; ++i) {
        if (!good(finite(a.arrays[i], a.numbers[i], 0), a.threads)) {
            out.flags[i] = *out.skip = 1.0f;
        }
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
