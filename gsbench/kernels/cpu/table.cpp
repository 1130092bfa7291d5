// The table of one instruction set's kernels, which dispatch.cpp chooses from.
#include "isa.h"

#define GSB_TEXT_(x) #x
#define GSB_TEXT(x) GSB_TEXT_(x)

namespace gsb {
inline namespace GSB_ISA {

extern const Kernels table;
const Kernels table{GSB_TEXT(GSB_ISA), project, project_backward, count_tiles, fill_tiles, blend, blend_backward,
                   l1_ssim, observe_triangular, observe_triangular_backward, observe_rotated, observe_rotated_backward,
                   observe_still, observe_still_backward, show_colors, show_colors_backward,
                   refine, refine_backward, adam, roofline_flops, roofline_triad, roofline_alphas};

}  // namespace GSB_ISA
}  // namespace gsb
