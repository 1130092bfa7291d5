// Which instruction sets this build has, and the best that this machine runs.
#pragma once

#include <string>
#include <vector>

#include "kernels.h"

namespace gsb {

// Names that are built in and run here, the best last.
std::vector<std::string> instruction_sets();

// The kernels of one of those; std::invalid_argument for any other name.
const Kernels& kernels_of(const std::string& isa);

}  // namespace gsb
