// Factors and opacities of balls, a thread for each; the mathematics is math/ball.h.
#include "../math/ball.h"

#include "rows.h"

namespace gsb::cuda {
namespace {

__global__ void ball_kernel(BallArgs a, StaticSlice out) {
    const int64_t i = global_thread();
    if (i >= a.N) return;
    const Ball<float> ball(a.radii[i], a.opacities[i]);
    float factor[3][3];
    ball.factor(factor);
    store_matrix(factor, out.factors, i);
    out.opacities[i] = ball.opacity;
}

__global__ void ball_backward_kernel(BallArgs a, StaticSliceGrads given, BallGrads out) {
    const int64_t i = global_thread();
    if (i >= a.N) return;
    const Ball<float> ball(a.radii[i], a.opacities[i]);
    float g_factor[3][3];
    load_matrix(given.factors, i, g_factor);
    out.radii[i] = ball.radius_vjp(g_factor);
    out.opacities[i] = ball.opacity_vjp(given.opacities[i]);
}

}  // namespace

void slice_ball(const BallArgs& a, const StaticSlice& out, Stream stream) {
    if (a.N > 0) launch(ball_kernel, small_blocks(a.N), SMALL_BLOCK, stream, a, out);
}

void slice_ball_backward(const BallArgs& a, const StaticSliceGrads& given, const BallGrads& out, Stream stream) {
    if (a.N > 0) launch(ball_backward_kernel, small_blocks(a.N), SMALL_BLOCK, stream, a, given, out);
}

}  // namespace gsb::cuda
