// Conditional 3D Gaussians of 6DGS and 7DGS Gaussians and their gradients, one Gaussian per thread. math/triangular.h
// has the formulas, and math/static_triangular.h those of static Gaussians.
#include "../math/static_triangular.h"
#include "../math/triangular.h"

#include <stdexcept>

#include "rows.h"

namespace gsb::cuda {
namespace {

// CONDITIONED (whether the rows of the factor are in the default order) is a template parameter, so that no reflections
// are compiled for the default order, which needs none.
template <Query Q, bool CONDITIONED>
__device__ TriangularModel model_of(const TriangularArgs& a) {
    using P = TriangularParameters<float, Q>;
    return {CONDITIONED, a.form, a.half, P::DIRECTION ? expf(*a.log_lambda_d) : 0.0f,
            P::TIME ? expf(*a.log_lambda_t) : 0.0f, {a.center[0], a.center[1], a.center[2]}, P::TIME ? *a.time : 0.0f};
}

template <Query Q>
__device__ TriangularParameters<float, Q> parameters(const TriangularArgs& a, int64_t i) {
    TriangularParameters<float, Q> p{};
    load_row(a.means, i, p.mean);
    if constexpr (p.DIRECTION) load_row(a.directions, i, p.direction);
    if constexpr (p.TIME) p.time = a.times[i];
    load_row(a.log_diagonal, i, p.log_diagonal);
    load_row(a.shape, i, p.shape);
    load_row(a.motion, i, p.motion);
    if constexpr (p.COUPLED) load_row(a.coupling, i, p.coupling);
    p.opacity = a.opacities[i];
    return p;
}

// The first row of position in log_diagonal.
template <Query Q, bool CONDITIONED>
constexpr int SPACE = CONDITIONED ? TriangularParameters<float, Q>::K : 0;

template <Query Q, bool CONDITIONED>
__device__ StaticTriangularParameters<float> static_parameters(const TriangularArgs& a, int64_t i) {
    StaticTriangularParameters<float> p{};
    const float* log_diagonal = a.log_diagonal + i * TriangularParameters<float, Q>::N + SPACE<Q, CONDITIONED>;
    GSB_UNROLL for (int k = 0; k < 3; ++k) p.log_diagonal[k] = log_diagonal[k];
    load_row(a.shape, i, p.shape);
    p.opacity = a.opacities[i];
    return p;
}

template <Query Q, bool CONDITIONED>
__global__ void observe_kernel(TriangularArgs a, Observation out) {
    const int64_t i = global_thread();
    if (i >= a.N) return;
    if (i >= a.conditioned) {
        const auto raw = static_parameters<Q, CONDITIONED>(a, i);
        const StaticTriangularGaussian<float> gaussian(raw, a.form);
        store_static(gaussian, a.means, out, i);
        return;
    }
    const TriangularModel model = model_of<Q, CONDITIONED>(a);
    const auto raw = parameters<Q>(a, i);
    const Observed<float> seen = TriangularGaussian<float, Q>(model, raw).observe();
    store_observed(seen, out, i);
}

template <Query Q, bool CONDITIONED>
__global__ void observe_backward_kernel(TriangularArgs a, ObservationGrads grads, TriangularGrads out) {
    const int64_t i = global_thread();
    TriangularParameters<float, Q> g{};  // of a static row mostly zero
    if (i >= a.conditioned && i < a.N) {
        const auto raw = static_parameters<Q, CONDITIONED>(a, i);
        StaticTriangularParameters<float> g_static{};
        const Observed<float> given = load_observed(grads, i);
        StaticTriangularGaussian<float>(raw, a.form).vjp(given.factor, given.opacity, g_static);
        GSB_UNROLL for (int k = 0; k < 3; ++k) {
            g.mean[k] = given.mean[k];
            g.log_diagonal[SPACE<Q, CONDITIONED> + k] = g_static.log_diagonal[k];
            g.shape[k] = g_static.shape[k];
        }
        g.opacity = g_static.opacity;
    } else if (i < a.N) {
        const TriangularModel model = model_of<Q, CONDITIONED>(a);
        const auto raw = parameters<Q>(a, i);
        TriangularGaussian<float, Q> gaussian(model, raw);
        gaussian.observe();
        gaussian.vjp(load_observed(grads, i), g);
    }
    if (i < a.N) {
        add_row(g.mean, out.means, i);
        if constexpr (g.DIRECTION) add_row(g.direction, out.directions, i);
        if constexpr (g.TIME) out.times[i] += g.time;
        add_row(g.log_diagonal, out.log_diagonal, i);
        add_row(g.shape, out.shape, i);
        add_row(g.motion, out.motion, i);
        if constexpr (g.COUPLED) add_row(g.coupling, out.coupling, i);
        out.opacities[i] += g.opacity;
    }
    const float lambda_d = warp_sum(g.lambda_d), lambda_t = warp_sum(g.lambda_t);
    if (threadIdx.x % WARP == 0) {
        if constexpr (g.DIRECTION) atomicAdd(out.log_lambda_d, lambda_d * expf(*a.log_lambda_d));
        if constexpr (g.TIME) atomicAdd(out.log_lambda_t, lambda_t * expf(*a.log_lambda_t));
    }
}

// Calls run<Query, CONDITIONED>() with the template parameters that the arguments ask for.
template <class Run>
void dispatch(const TriangularArgs& a, Run run) {
    if (a.subtracts) {
        throw std::invalid_argument(
            "slice_triangular: expected the square-root scheme on a GPU, got one that subtracts");
    }
    if (a.N == 0) return;
    observing(a.directions, a.times, [&]<Query Q>() {
        a.conditioned_first ? run.template operator()<Q, true>() : run.template operator()<Q, false>();
    });
}

}  // namespace

void slice_triangular(const TriangularArgs& a, const Observation& out, Stream stream) {
    dispatch(a, [&]<Query Q, bool CONDITIONED>() {
        launch(observe_kernel<Q, CONDITIONED>, small_blocks(a.N), SMALL_BLOCK, stream, a, out);
    });
}

void slice_triangular_backward(const TriangularArgs& a, const ObservationGrads& grads, const TriangularGrads& out,
                                 Stream stream) {
    dispatch(a, [&]<Query Q, bool CONDITIONED>() {
        launch(observe_backward_kernel<Q, CONDITIONED>, small_blocks(a.N), SMALL_BLOCK, stream, a, grads, out);
    });
}

}  // namespace gsb::cuda
