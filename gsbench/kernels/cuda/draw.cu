// Draws images by one call from Python, which would take longer to call the kernels one by one than a GPU to run them.
#include <cmath>

#include "launch.h"

namespace gsb::cuda {
namespace {

// A training that repeats `draw` learns by the loss that an image is wrong, without waiting for `needed`.
__global__ void spoil_kernel(BlendArgs a, Picture out, TileLists lists) {
    if (lists.needed[0] <= lists.room && lists.needed[1] == 0) return;
    const int64_t numbers = a.height * a.width * a.D;
    for (int64_t c = global_thread(); c < a.C; c += THREADS) out.image[c * numbers] = NAN;
}

}  // namespace

void draw(const ProjectArgs& a, const Splats& splats, const BlendArgs& b, const Picture& picture,
          const TileLists& lists, Stream stream) {
    fill_bytes(lists.needed, 0, 2 * sizeof *lists.needed, stream);
    const int64_t gaussians = (a.gaussian_per_camera ? a.C : 1) * a.N;
    const int64_t all_colors = (b.color_per_camera ? b.C : 1) * b.N * b.D;
    flag_values({gaussians, a.C, all_colors, b.D, a.means, a.factors, a.opacities, b.colors, a.viewmats, a.Ks,
                 b.background, a.shapes, a.threads},
                {lists.needed + 1}, stream);
    project(a, splats, stream);
    list_tiles(b, splats.depths, lists, stream);
    blend(b, picture, stream);
    launch(spoil_kernel, 1, THREADS, stream, b, picture, lists);
}

}  // namespace gsb::cuda
