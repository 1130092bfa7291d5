// The kernels of one instruction set, which its own namespace keeps apart from the others'.
#pragma once

#include "../math/scalar.h"
#include "kernels.h"

namespace gsb {
inline namespace GSB_ISA {

void project(const ProjectArgs&, const Splats&);
void project_backward(const ProjectArgs&, const Splats& grads, const ProjectGrads&);
int64_t count_tiles(const BinArgs&, int64_t* offsets);
void fill_tiles(const BinArgs&, const int64_t* offsets, int32_t* ids);
void blend(const BlendArgs&, const Picture&);
void blend_backward(const BlendArgs&, const Picture&, const BlendGrads&);
double l1_ssim(const SimilarityArgs&);
void observe_triangular(const TriangularArgs&, const Observation&);
void observe_triangular_backward(const TriangularArgs&, const Observation& grads, TriangularGrads&);
void observe_rotated(const RotatedArgs&, const Observation&);
void observe_rotated_backward(const RotatedArgs&, const Observation& grads, RotatedGrads&);
void observe_still(const StillArgs&, const StillSlice&);
void observe_still_backward(const StillArgs&, const StillSlice& grads, const StillGrads&);
void show_colors(const ColorArgs&, float* colors);
void show_colors_backward(const ColorArgs&, const ColorGrads&);
void refine(const RefineArgs&, float* const* out);
void refine_backward(const RefineArgs&, const float* const* grads, const RefineGrads&);
void adam(const AdamArgs&);
float roofline_flops(int64_t rounds);
void roofline_triad(float* a, const float* b, const float* c, int64_t n);
float roofline_alphas(int64_t rounds);

}  // namespace GSB_ISA
}  // namespace gsb
