// The valid ranges of the rasterizer's inputs, which `flag_values` checks on the CPU and on a GPU.
#pragma once

#include <cfloat>

#include "../arguments.h"

namespace gsb {

// An array of `count` numbers, `stride` apart, which must be in [low, high]; otherwise bit `bit` of the flags is set.
struct Range {
    const float* values;
    int64_t count, stride;
    float low, high;
    int bit;
};

constexpr int RANGES = 15;

struct Ranges {
    Range range[RANGES];
};

inline Range finite(const float* values, int64_t count, int bit) {
    return {values, count, 1, -FLT_MAX, FLT_MAX, bit};
}

inline Ranges ranges_of(const ValueArgs& a) {
    const auto of_Ks = [&](int entry, float low, float high) { return Range{a.Ks + entry, a.C, 9, low, high, 5}; };
    return {{finite(a.means, a.N * 3, 0), finite(a.factors, a.N * 9, 1), {a.opacities, a.N, 1, 0.0f, 1.0f, 2},
             finite(a.colors, a.all_colors, 3), finite(a.viewmats, a.C * 16, 4), finite(a.Ks, a.C * 9, 5),
             of_Ks(0, FLT_MIN, FLT_MAX), of_Ks(4, FLT_MIN, FLT_MAX),  // focal lengths
             of_Ks(1, 0.0f, 0.0f), of_Ks(3, 0.0f, 0.0f), of_Ks(6, 0.0f, 0.0f), of_Ks(7, 0.0f, 0.0f),
             of_Ks(8, 1.0f, 1.0f), finite(a.background, a.D, 6),
             {a.shapes, a.shapes ? a.N : 0, 1, FLT_MIN, FLT_MAX, 7}}};
}

}  // namespace gsb
