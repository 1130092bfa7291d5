// Conditional 3D Gaussians of 6DGS and 7DGS Gaussians, sixteen at a time. math/triangular.h has the formulas, and
// math/static_triangular.h those of static Gaussians.
#include "../math/static_triangular.h"
#include "../math/triangular.h"

#include "isa.h"
#include "observation.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

TriangularModel model_of(const TriangularArgs& a) {
    return {a.conditioned_first, a.form, a.half, a.directions ? expf(*a.log_lambda_d) : 0.0f,
            a.times ? expf(*a.log_lambda_t) : 0.0f, {a.center[0], a.center[1], a.center[2]}, a.times ? *a.time : 0.0f};
}

template <Query Q, template <class, int> class Reduction>
void observe(const TriangularArgs& a, const Observation& out) {
    const TriangularModel model = model_of(a);
    each_sixteen(0, a.conditioned, a.threads, [&](int64_t i, int n) {
        const auto raw = load_raw<TriangularParameters<Vec, Q>>(a, i, n);
        TriangularGaussian<Vec, Q, Reduction> gaussian(model, raw);
        store(gaussian.observe(), out, i, n);
    });
}

template <Query Q, template <class, int> class Reduction>
void observe_backward(const TriangularArgs& a, const ObservationGrads& grads, const TriangularGrads& out) {
    const TriangularModel model = model_of(a);
    double totals[2];
    sum_sixteens(a.conditioned, a.threads, totals, [&](int64_t i, int n, Vec (&lambdas)[2]) {
        if (is_zero(grads, i, n)) return;
        const auto raw = load_raw<TriangularParameters<Vec, Q>>(a, i, n);
        TriangularParameters<Vec, Q> g;
        Observed<Vec> given;
        load(grads, i, n, given);
        TriangularGaussian<Vec, Q, Reduction> gaussian(model, raw);
        gaussian.observe();
        gaussian.vjp(given, g);
        g.each(out, AddRows{i, n});
        add_first(g.opacity, out.opacities + i, n);
        lambdas[0] += g.lambda_d;  // lanes past the end were given zero
        lambdas[1] += g.lambda_t;
    });
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
};

void slice_static_rows(const TriangularArgs& a, const Observation& out) {
    const StaticRows rows(a);
    each_sixteen(a.conditioned, a.N, a.threads, [&](int64_t i, int n) {
        StaticTriangularParameters<Vec> raw;
        rows.load(i, n, raw);
        const StaticTriangularGaussian<Vec> seen(raw, a.form);
        copy_rows(a.means, out.means, 3, i, i + n);
        scatter_matrix(seen.factor, out.factors, i, n);
        store_first(seen.opacity, out.opacities + i, n);
    });
}

void slice_static_rows_backward(const TriangularArgs& a, const ObservationGrads& grads, const TriangularGrads& out) {
    const StaticRows rows(a);
    each_sixteen(a.conditioned, a.N, a.threads, [&](int64_t i, int n) {
        if (is_zero(grads, i, n)) return;
        StaticTriangularParameters<Vec> raw, g;
        Observed<Vec> given;
        rows.load(i, n, raw);
        load(grads, i, n, given);
        StaticTriangularGaussian<Vec>(raw, a.form).vjp(given.factor, given.opacity, g);
        add_row(given.mean, out.means, i, n);
        add_columns(g.log_diagonal, out.log_diagonal, rows.width, rows.space, i, n);
        add_row(g.shape, out.shape, i, n);
        add_first(g.opacity, out.opacities + i, n);
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
