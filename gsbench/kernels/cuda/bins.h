// Lists the projected Gaussians of each tile; a part of `draw`.
#pragma once

#include "kernels.h"

namespace gsb::cuda {

// Reads the splats of `blend`, and their depths [C, N].
void list_tiles(const BlendArgs&, const float* depths, const TileLists&, Stream);

}  // namespace gsb::cuda
