// Conditional 3D Gaussians of 6DGS and 7DGS Gaussians, sixteen at a time. math/triangular.h has the formulas, and
// math/static_triangular.h those of static Gaussians.
#include "../math/static_triangular.h"
#include "../math/triangular.h"

#include "buffer.h"
#include "isa.h"
#include "observation.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int64_t CHUNK = 512;  // Gaussians a task; the gradients of lambda are summed by chunks

TriangularModel model_of(const TriangularArgs& a) {
    return {a.conditioned_first, a.form, a.half, a.directions ? expf(*a.log_lambda_d) : 0.0f,
            a.times ? expf(*a.log_lambda_t) : 0.0f, {a.center[0], a.center[1], a.center[2]}, a.times ? *a.time : 0.0f};
}

template <Query Q, template <class, int> class Reduction>
void observe(const TriangularArgs& a, const Observation& out) {
    const TriangularModel model = model_of(a);
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.conditioned > CHUNK)
    for (int64_t i = 0; i < a.conditioned; i += LANES) {
        const int n = lanes_from(i, a.conditioned);
        TriangularParameters<Vec, Q> raw;
        raw.each(a, LoadRows{i, n});
        raw.opacity = load_first(a.opacities + i, n);
        TriangularGaussian<Vec, Q, Reduction> gaussian(model, raw);
        store(gaussian.observe(), out, i, n);
    }
}

template <Query Q, template <class, int> class Reduction>
void observe_backward(const TriangularArgs& a, const ObservationGrads& grads, const TriangularGrads& out) {
    const TriangularModel model = model_of(a);
    const int64_t chunks = (a.conditioned + CHUNK - 1) / CHUNK;
    Buffer<float> lambdas(static_cast<size_t>(chunks) * 2);
#pragma omp parallel for num_threads(a.threads) schedule(static) if (chunks > 1)
    for (int64_t chunk = 0; chunk < chunks; ++chunk) {
        const int64_t end = (chunk + 1) * CHUNK < a.conditioned ? (chunk + 1) * CHUNK : a.conditioned;
        Vec lambda_d(0.0f), lambda_t(0.0f);
        for (int64_t i = chunk * CHUNK; i < end; i += LANES) {
            const int n = lanes_from(i, end);
            if (is_zero(grads, i, n)) continue;
            TriangularParameters<Vec, Q> raw, g;
            Observed<Vec> given;
            raw.each(a, LoadRows{i, n});
            raw.opacity = load_first(a.opacities + i, n);
            load(grads, i, n, given);
            TriangularGaussian<Vec, Q, Reduction> gaussian(model, raw);
            gaussian.observe();
            gaussian.vjp(given, g);
            g.each(out, AddRows{i, n});
            add_first(g.opacity, out.opacities + i, n);
            lambda_d += g.lambda_d;  // lanes past the end were given zero
            lambda_t += g.lambda_t;
        }
        lambdas[static_cast<size_t>(chunk) * 2] = sum(lambda_d);
        lambdas[static_cast<size_t>(chunk) * 2 + 1] = sum(lambda_t);
    }
    double totals[2] = {};
    for (size_t k = 0; k < static_cast<size_t>(chunks) * 2; ++k) totals[k % 2] += lambdas[k];
    if (a.directions) *out.log_lambda_d = static_cast<float>(totals[0]) * model.lambda_d;
    if (a.times) *out.log_lambda_t = static_cast<float>(totals[1]) * model.lambda_t;
}

// The rows of static Gaussians, which use only the position columns of log_diagonal.
struct StaticRows {
    const TriangularArgs& a;
    int width, space;  // of log_diagonal; where the columns of p begin

    GSB_HD explicit StaticRows(const TriangularArgs& a)
        : a(a), width(3 + (a.directions ? 3 : 0) + (a.times ? 1 : 0)), space(a.conditioned_first ? width - 3 : 0) {}

    GSB_HD void load(int64_t i, int n, StaticTriangularParameters<Vec>& p) const {
        gather_columns(a.log_diagonal, width, space, i, n, p.log_diagonal);
        gather_row(a.shape, i, n, p.shape);
        p.opacity = load_first(a.opacities + i, n);
    }

    // Calls f(first, end) for tasks of at most CHUNK rows.
    template <class F>
    void each_chunk(F f) const {
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N - a.conditioned > CHUNK)
        for (int64_t first = a.conditioned; first < a.N; first += CHUNK) {
            f(first, first + CHUNK < a.N ? first + CHUNK : a.N);
        }
    }
};

void slice_static_rows(const TriangularArgs& a, const Observation& out) {
    const StaticRows rows(a);
    rows.each_chunk([&](int64_t first, int64_t end) {
        copy_rows(a.means, out.means, 3, first, end);
        for (int64_t i = first; i < end; i += LANES) {
            const int n = lanes_from(i, end);
            StaticTriangularParameters<Vec> raw;
            rows.load(i, n, raw);
            const StaticTriangularGaussian<Vec> seen(raw, a.form);
            scatter_matrix(seen.factor, out.factors, i, n);
            store_first(seen.opacity, out.opacities + i, n);
        }
    });
}

void slice_static_rows_backward(const TriangularArgs& a, const ObservationGrads& grads, const TriangularGrads& out) {
    const StaticRows rows(a);
    rows.each_chunk([&](int64_t first, int64_t end) {
        for (int64_t i = first; i < end; i += LANES) {
            const int n = lanes_from(i, end);
            if (is_zero(grads, i, n)) continue;
            StaticTriangularParameters<Vec> raw, g;
            Observed<Vec> given;
            rows.load(i, n, raw);
            load(grads, i, n, given);
            StaticTriangularGaussian<Vec>(raw, a.form).vjp(given.factor, given.opacity, g);
            add_row(given.mean, out.means, i, n);
            add_columns(g.log_diagonal, out.log_diagonal, rows.width, rows.space, i, n);
            add_row(g.shape, out.shape, i, n);
            add_first(g.opacity, out.opacities + i, n);
        }
    });
}

// Calls run<Query, Reduction>() with the template parameters that the arguments ask for.
template <class Run>
void dispatch(const TriangularArgs& a, Run run) {
    observing(a.directions, a.times, [&]<Query Q>() {
        a.subtracts ? run.template operator()<Q, Subtraction>() : run.template operator()<Q, Reflections>();
    });
}

}  // namespace

void slice_triangular(const TriangularArgs& a, const Observation& out) {
    slice_static_rows(a, out);
    dispatch(a, [&]<Query Q, template <class, int> class Reduction>() { observe<Q, Reduction>(a, out); });
}

void slice_triangular_backward(const TriangularArgs& a, const ObservationGrads& grads, const TriangularGrads& out) {
    slice_static_rows_backward(a, grads, out);
    dispatch(a, [&]<Query Q, template <class, int> class Reduction>() { observe_backward<Q, Reduction>(a, grads, out); });
}

}  // namespace GSB_ISA
}  // namespace gsb
