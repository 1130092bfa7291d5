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
__device__ TriangularModel model_of(const TriangularArgs& a, int64_t view) {
    using P = TriangularParameters<float, Q>;
    const float* center = a.center + view * 3;
    return {CONDITIONED, a.form, a.half, P::DIRECTION ? expf(*a.log_lambda_d) : 0.0f,
            P::TIME ? expf(*a.log_lambda_t) : 0.0f, {center[0], center[1], center[2]}, P::TIME ? a.time[view] : 0.0f};
}

// The first row of position in log_diagonal.
template <Query Q, bool CONDITIONED>
constexpr int SPACE = CONDITIONED ? TriangularParameters<float, Q>::K : 0;

template <Query Q, bool CONDITIONED>
__device__ StaticTriangularParameters<float> static_parameters(const TriangularArgs& a, int64_t row, int64_t i) {
    StaticTriangularParameters<float> p{};
    const float* log_diagonal = a.log_diagonal + row * TriangularParameters<float, Q>::N + SPACE<Q, CONDITIONED>;
    GSB_UNROLL for (int k = 0; k < 3; ++k) p.log_diagonal[k] = log_diagonal[k];
    load_row(a.shape, row, p.shape);
    p.opacity = a.opacities[i];
    return p;
}

template <Query Q, bool CONDITIONED>
__global__ void observe_kernel(TriangularArgs a, Observation out) {
    const int64_t i = global_thread();
    if (i >= a.N) return;
    for (int64_t view = 0; view < a.V; ++view) {
        const int64_t row = raw_row(a, view, i), at = view * a.N + i;
        if (i >= a.conditioned) {
            const auto raw = static_parameters<Q, CONDITIONED>(a, row, i);
            const StaticTriangularGaussian<float> gaussian(raw, a.form);
            store_static(gaussian, a.means, row, out, at);
            continue;
        }
        const TriangularModel model = model_of<Q, CONDITIONED>(a, view);
        const auto raw = load_raw<TriangularParameters<float, Q>>(a, row, i);
        const Observed<float> seen = TriangularGaussian<float, Q>(model, raw).observe();
        store_observed(seen, out, at);
    }
}

template <Query Q, bool CONDITIONED>
__global__ void observe_backward_kernel(TriangularArgs a, ObservationGrads grads, TriangularGrads out) {
    const int64_t i = global_thread();
    TriangularParameters<float, Q> sum{};
    for (int64_t view = 0; view < (i < a.N ? a.V : 0); ++view) {
        const int64_t row = raw_row(a, view, i);
        const Observed<float> given = load_observed(grads, view * a.N + i);
        TriangularParameters<float, Q> g{};  // of a static row mostly zero
        if (i >= a.conditioned) {
            const auto raw = static_parameters<Q, CONDITIONED>(a, row, i);
            StaticTriangularParameters<float> g_static{};
            StaticTriangularGaussian<float>(raw, a.form).vjp(given.factor, given.opacity, g_static);
            GSB_UNROLL for (int k = 0; k < 3; ++k) {
                g.mean[k] = given.mean[k];
                g.log_diagonal[SPACE<Q, CONDITIONED> + k] = g_static.log_diagonal[k];
                g.shape[k] = g_static.shape[k];
            }
            g.opacity = g_static.opacity;
        } else {
            const TriangularModel model = model_of<Q, CONDITIONED>(a, view);
            const auto raw = load_raw<TriangularParameters<float, Q>>(a, row, i);
            TriangularGaussian<float, Q> gaussian(model, raw);
            gaussian.observe();
            gaussian.vjp(given, g);
        }
        accumulate(sum, g);
        if (a.raw_per_view) g.each(out, AddRow{row});
    }
    if (i < a.N) {
        if (!a.raw_per_view) sum.each(out, AddRow{i});
        out.opacities[i] += sum.opacity;
    }
    const float lambda_d = warp_sum(sum.lambda_d), lambda_t = warp_sum(sum.lambda_t);
    if (threadIdx.x % WARP == 0) {
        if constexpr (sum.DIRECTION) atomicAdd(out.log_lambda_d, lambda_d * expf(*a.log_lambda_d));
        if constexpr (sum.TIME) atomicAdd(out.log_lambda_t, lambda_t * expf(*a.log_lambda_t));
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
