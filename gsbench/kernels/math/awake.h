// When AGR moves a Gaussian.
#pragma once

#include <cstdint>

#include "scalar.h"

namespace gsb {
inline namespace GSB_ISA {

// `spans` [., 2] and `time` []: a Gaussian is moved at times from the first to the last of its span. Null: always.
GSB_HD inline bool is_awake(const float* spans, const float* time, int64_t i) {
    return !spans || (spans[2 * i] <= *time && *time <= spans[2 * i + 1]);
}

}  // namespace GSB_ISA
}  // namespace gsb
