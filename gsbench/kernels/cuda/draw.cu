// Draws images by one call from Python, which would take longer to call the kernels one by one than a GPU to run them.
#include "bins.h"
#include "launch.h"

namespace gsb::cuda {

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
}

}  // namespace gsb::cuda
