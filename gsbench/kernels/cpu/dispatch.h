// The instruction sets for which the kernels are built, and the best one that this processor supports.
#pragma once

#include <string>
#include <vector>

#include "kernels.h"

namespace gsb {

// Returns the instruction sets that are built and that this processor supports, the best last.
std::vector<std::string> instruction_sets();

// Returns the kernels of one of these instruction sets; throws std::invalid_argument for any other name.
const Kernels& kernels_of(const std::string& isa);

}  // namespace gsb
