// The time interval in which AGR changes a Gaussian.
#pragma once

#include <cstdint>

#include "scalar.h"

namespace gsb {
inline namespace GSB_ISA {

// Returns whether Gaussian i is changed by AGR at `time`: from the first to the last time of its interval in
// `intervals` [., 2]. If `intervals` is null, always.
GSB_HD inline bool is_awake(const float* intervals, const float* time, int64_t i) {
    return !intervals || (intervals[2 * i] <= *time && *time <= intervals[2 * i + 1]);
}

}  // namespace GSB_ISA
}  // namespace gsb
