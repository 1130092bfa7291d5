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

constexpr int64_t FEW = 512;  // Gaussians that are not worth a second thread

// ---- dGS

ViewPoint view_of(const DirectArgs& a) { return {{a.center[0], a.center[1], a.center[2]}, *a.time}; }

// The parameters of a static Gaussian, of dGS or FreeTimeGS.
template <class Args>
GSB_HD inline void load_still(const Args& a, int64_t i, int n, StaticParameters<Vec>& p) {
    gather_row(a.scales, i, n, p.scales);
    gather_row(a.quats, i, n, p.quat);
    p.opacity = load_first(a.opacities + i, n);
}

template <class Grads>
GSB_HD inline void add_still(const StaticParameters<Vec>& g, const Grads& out, int64_t i, int n) {
    add_row(g.scales, out.scales, i, n);
    add_row(g.quat, out.quats, i, n);
    add_first(g.opacity, out.opacities + i, n);
}

GSB_HD inline void load(const DirectArgs& a, int64_t i, int n, DirectParameters<Vec>& p) {
    load_still(a, i, n, p.still);
    gather_row(a.means, i, n, p.mean);
    gather_row(a.directions, i, n, p.direction);
    p.time = load_first(a.times + i, n);
    gather_row(a.precision, i, n, p.motion.precision);
    gather_row(a.coupling, i, n, p.motion.coupling);
    gather_row(a.shares, i, n, p.shares);
}

GSB_HD inline void add(const DirectParameters<Vec>& g, const DirectGrads& out, int64_t i, int n) {
    add_still(g.still, out, i, n);
    add_row(g.mean, out.means, i, n);
    add_row(g.direction, out.directions, i, n);
    add_first(g.time, out.times + i, n);
    add_row(g.motion.precision, out.precision, i, n);
    add_row(g.motion.coupling, out.coupling, i, n);
    add_row(g.shares, out.shares, i, n);
}

GSB_HD inline void store_still(const StaticGaussian<Vec>& seen, const Observation& out, int64_t i, int n) {
    scatter_matrix(seen.factor, out.factors, i, n);
    store_first(seen.opacity, out.opacities + i, n);
}

GSB_HD inline void still_vjp(const StaticGaussian<Vec>& still, const Observed<Vec>& g, StaticParameters<Vec>& out) {
    still.vjp(g.factor, g.opacity, out);
}

// ---- dBS

template <class T>
using Beta3 = DirectBetaGaussian<T, 3>;  // without time
template <class T>
using Beta4 = DirectBetaGaussian<T, 4>;

ViewPoint view_of(const DirectBetaArgs& a) {
    return {{a.center[0], a.center[1], a.center[2]}, a.time ? *a.time : 0.0f};
}

// The first entry of `betas` belongs to the profile, the others to the opacity factor.
GSB_HD inline void load_still(const DirectBetaArgs& a, int64_t i, int n, StaticBetaParameters<Vec>& p) {
    const int width = a.times ? 5 : 4;
    gather_row(a.scales, i, n, p.scales);
    gather_row(a.skew, i, n, p.skew);
    p.opacity = load_first(a.opacities + i, n);
    p.beta = gather(a.betas + i * width, width, n);
}

GSB_HD inline void add_still(const StaticBetaParameters<Vec>& g, const DirectBetaGrads& out, int64_t i, int n) {
    const int width = out.times ? 5 : 4;
    const Vec beta[1] = {g.beta};
    add_row(g.scales, out.scales, i, n);
    add_row(g.skew, out.skew, i, n);
    add_first(g.opacity, out.opacities + i, n);
    add_columns(beta, out.betas, width, 0, i, n);
}

template <int K>
GSB_HD inline void load(const DirectBetaArgs& a, int64_t i, int n, DirectBetaParameters<Vec, K>& p) {
    load_still(a, i, n, p.still);
    gather_row(a.means, i, n, p.mean);
    gather_row(a.directions, i, n, p.direction);
    if constexpr (K > 3) p.time = load_first(a.times + i, n);
    gather_row(a.precision, i, n, p.motion.precision);
    gather_row(a.coupling, i, n, p.motion.coupling);
    gather_columns(a.betas, 1 + K, 1, i, n, p.betas);
}

template <int K>
GSB_HD inline void add(const DirectBetaParameters<Vec, K>& g, const DirectBetaGrads& out, int64_t i, int n) {
    add_still(g.still, out, i, n);
    add_row(g.mean, out.means, i, n);
    add_row(g.direction, out.directions, i, n);
    if constexpr (K > 3) add_first(g.time, out.times + i, n);
    add_row(g.motion.precision, out.precision, i, n);
    add_row(g.motion.coupling, out.coupling, i, n);
    add_columns(g.betas, out.betas, 1 + K, 1, i, n);
}

GSB_HD inline void store_still(const StaticBetaGaussian<Vec>& seen, const BetaSlice& out, int64_t i, int n) {
    scatter_matrix(seen.factor, out.factors, i, n);
    store_first(seen.opacity, out.opacities + i, n);
    store_first(seen.shape, out.shapes + i, n);
}

GSB_HD inline void still_vjp(const StaticBetaGaussian<Vec>& still, const ObservedBeta<Vec>& g,
                             StaticBetaParameters<Vec>& out) {
    still.vjp(g.factor, g.opacity, g.shape, out);
}

// ---- FreeTimeGS

ViewPoint view_of(const FreeTimeArgs& a) { return {{}, *a.time}; }

GSB_HD inline void load(const FreeTimeArgs& a, int64_t i, int n, FreeTimeParameters<Vec>& p) {
    load_still(a, i, n, p.still);
    gather_row(a.means, i, n, p.mean);
    p.time = load_first(a.times + i, n);
    p.duration = load_first(a.durations + i, n);
    gather_row(a.velocities, i, n, p.velocity);
}

GSB_HD inline void add(const FreeTimeParameters<Vec>& g, const FreeTimeGrads& out, int64_t i, int n) {
    add_still(g.still, out, i, n);
    add_row(g.mean, out.means, i, n);
    add_first(g.time, out.times + i, n);
    add_first(g.duration, out.durations + i, n);
    add_row(g.velocity, out.velocities, i, n);
}

// ---- SharpTimeGS

GSB_HD inline void load(const FreeTimeArgs& a, int64_t i, int n, SharpTimeParameters<Vec>& p) {
    load(a, i, n, static_cast<FreeTimeParameters<Vec>&>(p));
    p.plateau = load_first(a.plateaus + i, n);
}

GSB_HD inline void add(const SharpTimeParameters<Vec>& g, const FreeTimeGrads& out, int64_t i, int n) {
    add(static_cast<const FreeTimeParameters<Vec>&>(g), out, i, n);
    add_first(g.plateau, out.plateaus + i, n);
}

// ---- all of them

template <template <class> class Model, class Args, class Slice>
void slice(const Args& a, const Slice& out) {
    using Gaussian = Model<Vec>;
    const ViewPoint view = view_of(a);
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.conditioned > FEW)
    for (int64_t i = 0; i < a.conditioned; i += LANES) {
        const int n = lanes_from(i, a.conditioned);
        typename Gaussian::Parameters raw;
        load(a, i, n, raw);
        store(Gaussian(raw, view).observe(), out, i, n);
    }
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N - a.conditioned > FEW)
    for (int64_t i = a.conditioned; i < a.N; i += LANES) {
        const int n = lanes_from(i, a.N);
        typename Gaussian::StillParameters raw;
        load_still(a, i, n, raw);
        copy_rows(a.means, out.means, 3, i, i + n);
        store_still(typename Gaussian::Still(raw), out, i, n);
    }
}

template <template <class> class Model, class Args, class Given, class Grads>
void slice_backward(const Args& a, const Given& grads, const Grads& out) {
    using Gaussian = Model<Vec>;
    const ViewPoint view = view_of(a);
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.conditioned > FEW)
    for (int64_t i = 0; i < a.conditioned; i += LANES) {
        const int n = lanes_from(i, a.conditioned);
        if (is_zero(grads, i, n)) continue;
        typename Gaussian::Parameters raw, g;
        typename Gaussian::Seen given;
        load(a, i, n, raw);
        load(grads, i, n, given);
        Gaussian(raw, view).vjp(given, g);
        add(g, out, i, n);
    }
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N - a.conditioned > FEW)
    for (int64_t i = a.conditioned; i < a.N; i += LANES) {
        const int n = lanes_from(i, a.N);
        if (is_zero(grads, i, n)) continue;
        typename Gaussian::StillParameters raw, g;
        typename Gaussian::Seen given;
        load_still(a, i, n, raw);
        load(grads, i, n, given);
        still_vjp(typename Gaussian::Still(raw), given, g);
        add_still(g, out, i, n);
        add_row(given.mean, out.means, i, n);
    }
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
