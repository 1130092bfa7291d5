// Slices of 3D Gaussians that move and fade (dGS, dBS, FreeTimeGS, SharpTimeGS), sixteen at a time. math/direct.h,
// math/direct_beta.h, math/free_time.h and math/sharp_time.h have the formulas.
#include "../math/direct.h"
#include "../math/direct_beta.h"
#include "../math/free_time.h"
#include "../math/sharp_time.h"

#include "isa.h"
#include "observation.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

template <class T>
using Beta3 = DirectBetaGaussian<T, 3>;  // without time
template <class T>
using Beta4 = DirectBetaGaussian<T, 4>;

GSB_HD inline void store_still(const StaticGaussian<Vec>& seen, const Observation& out, int64_t i, int n) {
    scatter_matrix(seen.factor, out.factors, i, n);
    store_first(seen.opacity, out.opacities + i, n);
}

GSB_HD inline void store_still(const StaticBetaGaussian<Vec>& seen, const BetaSlice& out, int64_t i, int n) {
    scatter_matrix(seen.factor, out.factors, i, n);
    store_first(seen.opacity, out.opacities + i, n);
    store_first(seen.shape, out.shapes + i, n);
}

template <template <class> class Model, class Args, class Slice>
void slice(const Args& a, const Slice& out) {
    using Gaussian = Model<Vec>;
    const ViewPoint view = view_of(a);
    each_sixteen(0, a.conditioned, a.threads, [&](int64_t i, int n) {
        typename Gaussian::Parameters raw;
        raw.each(a, LoadRows{i, n});
        raw.still.opacity = load_first(a.opacities + i, n);
        store(Gaussian(raw, view).observe(), out, i, n);
    });
    each_sixteen(a.conditioned, a.N, a.threads, [&](int64_t i, int n) {
        const auto raw = load_raw<typename Gaussian::StillParameters>(a, i, n);
        copy_rows(a.means, out.means, 3, i, i + n);
        store_still(typename Gaussian::Still(raw), out, i, n);
    });
}

template <template <class> class Model, class Args, class Given, class Grads>
void slice_backward(const Args& a, const Given& grads, const Grads& out) {
    using Gaussian = Model<Vec>;
    const ViewPoint view = view_of(a);
    each_sixteen(0, a.conditioned, a.threads, [&](int64_t i, int n) {
        if (is_zero(grads, i, n)) return;
        typename Gaussian::Parameters raw, g;
        typename Gaussian::Seen given;
        raw.each(a, LoadRows{i, n});
        raw.still.opacity = load_first(a.opacities + i, n);
        load(grads, i, n, given);
        Gaussian(raw, view).vjp(given, g);
        g.each(out, AddRows{i, n});
        add_first(g.still.opacity, out.opacities + i, n);
    });
    each_sixteen(a.conditioned, a.N, a.threads, [&](int64_t i, int n) {
        if (is_zero(grads, i, n)) return;
        const auto raw = load_raw<typename Gaussian::StillParameters>(a, i, n);
        typename Gaussian::StillParameters g;
        typename Gaussian::Seen given;
        load(grads, i, n, given);
        still_vjp(typename Gaussian::Still(raw), given, g);
        g.each(out, AddRows{i, n});
        add_first(g.opacity, out.opacities + i, n);
        add_row(given.mean, out.means, i, n);
    });
}

}  // namespace

void slice_direct(const DirectArgs& a, const Observation& out) { slice<DirectGaussian>(a, out); }

void slice_direct_backward(const DirectArgs& a, const ObservationGrads& grads, const DirectGrads& out) {
    slice_backward<DirectGaussian>(a, grads, out);
}

void slice_direct_beta(const DirectBetaArgs& a, const BetaSlice& out) {
    a.times ? slice<Beta4>(a, out) : slice<Beta3>(a, out);
}

void slice_direct_beta_backward(const DirectBetaArgs& a, const BetaSliceGrads& grads, const DirectBetaGrads& out) {
    a.times ? slice_backward<Beta4>(a, grads, out) : slice_backward<Beta3>(a, grads, out);
}

void slice_free_time(const FreeTimeArgs& a, const Observation& out) {
    a.plateaus ? slice<SharpTimeGaussian>(a, out) : slice<FreeTimeGaussian>(a, out);
}

void slice_free_time_backward(const FreeTimeArgs& a, const ObservationGrads& grads, const FreeTimeGrads& out) {
    a.plateaus ? slice_backward<SharpTimeGaussian>(a, grads, out) : slice_backward<FreeTimeGaussian>(a, grads, out);
}

}  // namespace GSB_ISA
}  // namespace gsb
