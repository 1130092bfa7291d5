// When AGR moves a Gaussian.
#pragma once

#include <cstdint>

#include "scalar.h"

namespace gsb {
inline namespace GSB_ISA {

// `intervals` [., 2] and `time` []: a Gaussian is moved from the first to the last time of its visible interval. Null:
// always.
GSB_HD inline bool is_awake(const float* intervals, const float* time, int64_t i) {
    return !intervals || (intervals[2 * i] <= *time && *time <= intervals[2 * i + 1]);
}

}  // namespace GSB_ISA
}  // namespace gsb
