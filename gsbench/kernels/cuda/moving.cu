// Slices of 3D Gaussians that move and fade (dGS, dBS, FreeTimeGS, SharpTimeGS) and their gradients, one Gaussian per thread.
// math/direct.h, math/direct_beta.h, math/free_time.h and math/sharp_time.h have the formulas.
#include "../math/direct.h"
#include "../math/direct_beta.h"
#include "../math/free_time.h"
#include "../math/sharp_time.h"

#include "rows.h"

namespace gsb::cuda {
namespace {

// ---- dGS

__device__ ViewPoint view_of(const DirectArgs& a) { return {{a.center[0], a.center[1], a.center[2]}, *a.time}; }

// The parameters of a static Gaussian, of dGS or FreeTimeGS.
template <class Args>
__device__ void load_still(const Args& a, int64_t i, StaticParameters<float>& p) {
    load_row(a.scales, i, p.scales);
    load_row(a.quats, i, p.quat);
    p.opacity = a.opacities[i];
}

template <class Grads>
__device__ void add_still(const StaticParameters<float>& g, const Grads& out, int64_t i) {
    add_row(g.scales, out.scales, i);
    add_row(g.quat, out.quats, i);
    out.opacities[i] += g.opacity;
}

__device__ void load(const DirectArgs& a, int64_t i, DirectParameters<float>& p) {
    load_still(a, i, p.still);
    load_row(a.means, i, p.mean);
    load_row(a.directions, i, p.direction);
    p.time = a.times[i];
    load_row(a.precision, i, p.motion.precision);
    load_row(a.coupling, i, p.motion.coupling);
    load_row(a.shares, i, p.shares);
}

__device__ void add(const DirectParameters<float>& g, const DirectGrads& out, int64_t i) {
    add_still(g.still, out, i);
    add_row(g.mean, out.means, i);
    add_row(g.direction, out.directions, i);
    out.times[i] += g.time;
    add_row(g.motion.precision, out.precision, i);
    add_row(g.motion.coupling, out.coupling, i);
    add_row(g.shares, out.shares, i);
}

__device__ void store_still(const StaticGaussian<float>& seen, const float* means, const Observation& out, int64_t i) {
    store_static(seen, means, out, i);
}

__device__ void store(const Observed<float>& seen, const Observation& out, int64_t i) { store_observed(seen, out, i); }

__device__ void store(const ObservedBeta<float>& seen, const BetaSlice& out, int64_t i) { store_observed(seen, out, i); }

__device__ void load(const ObservationGrads& given, int64_t i, Observed<float>& out) { out = load_observed(given, i); }

__device__ void load(const BetaSliceGrads& given, int64_t i, ObservedBeta<float>& out) { out = load_observed(given, i); }

__device__ void still_vjp(const StaticGaussian<float>& still, const Observed<float>& g, StaticParameters<float>& out) {
    still.vjp(g.factor, g.opacity, out);
}

// ---- dBS

template <class T>
using Beta3 = DirectBetaGaussian<T, 3>;  // without time
template <class T>
using Beta4 = DirectBetaGaussian<T, 4>;

__device__ ViewPoint view_of(const DirectBetaArgs& a) {
    return {{a.center[0], a.center[1], a.center[2]}, a.time ? *a.time : 0.0f};
}

// The first entry of `betas` belongs to the profile, the others to the opacity factor.
__device__ void load_still(const DirectBetaArgs& a, int64_t i, StaticBetaParameters<float>& p) {
    load_row(a.scales, i, p.scales);
    load_row(a.skew, i, p.skew);
    p.opacity = a.opacities[i];
    p.beta = a.betas[i * (a.times ? 5 : 4)];
}

__device__ void add_still(const StaticBetaParameters<float>& g, const DirectBetaGrads& out, int64_t i) {
    add_row(g.scales, out.scales, i);
    add_row(g.skew, out.skew, i);
    out.opacities[i] += g.opacity;
    out.betas[i * (out.times ? 5 : 4)] += g.beta;
}

template <int K>
__device__ void load(const DirectBetaArgs& a, int64_t i, DirectBetaParameters<float, K>& p) {
    load_still(a, i, p.still);
    load_row(a.means, i, p.mean);
    load_row(a.directions, i, p.direction);
    if constexpr (K > 3) p.time = a.times[i];
    load_row(a.precision, i, p.motion.precision);
    load_row(a.coupling, i, p.motion.coupling);
    GSB_UNROLL for (int k = 0; k < K; ++k) p.betas[k] = a.betas[i * (1 + K) + 1 + k];
}

template <int K>
__device__ void add(const DirectBetaParameters<float, K>& g, const DirectBetaGrads& out, int64_t i) {
    add_still(g.still, out, i);
    add_row(g.mean, out.means, i);
    add_row(g.direction, out.directions, i);
    if constexpr (K > 3) out.times[i] += g.time;
    add_row(g.motion.precision, out.precision, i);
    add_row(g.motion.coupling, out.coupling, i);
    GSB_UNROLL for (int k = 0; k < K; ++k) out.betas[i * (1 + K) + 1 + k] += g.betas[k];
}

__device__ void store_still(const StaticBetaGaussian<float>& seen, const float* means, const BetaSlice& out, int64_t i) {
    store_static(seen, means, Observation{out.means, out.factors, out.opacities}, i);
    out.shapes[i] = seen.shape;
}

__device__ void still_vjp(const StaticBetaGaussian<float>& still, const ObservedBeta<float>& g,
                          StaticBetaParameters<float>& out) {
    still.vjp(g.factor, g.opacity, g.shape, out);
}

// ---- FreeTimeGS

__device__ ViewPoint view_of(const FreeTimeArgs& a) { return {{}, *a.time}; }

__device__ void load(const FreeTimeArgs& a, int64_t i, FreeTimeParameters<float>& p) {
    load_still(a, i, p.still);
    load_row(a.means, i, p.mean);
    p.time = a.times[i];
    p.duration = a.durations[i];
    load_row(a.velocities, i, p.velocity);
}

__device__ void add(const FreeTimeParameters<float>& g, const FreeTimeGrads& out, int64_t i) {
    add_still(g.still, out, i);
    add_row(g.mean, out.means, i);
    out.times[i] += g.time;
    out.durations[i] += g.duration;
    add_row(g.velocity, out.velocities, i);
}

// ---- SharpTimeGS

__device__ void load(const FreeTimeArgs& a, int64_t i, SharpTimeParameters<float>& p) {
    load(a, i, static_cast<FreeTimeParameters<float>&>(p));
    p.plateau = a.plateaus[i];
}

__device__ void add(const SharpTimeParameters<float>& g, const FreeTimeGrads& out, int64_t i) {
    add(static_cast<const FreeTimeParameters<float>&>(g), out, i);
    out.plateaus[i] += g.plateau;
}

// ---- all of them

template <template <class> class Model, class Args, class Slice>
__global__ void slice_kernel(Args a, Slice out) {
    using Gaussian = Model<float>;
    const int64_t i = global_thread();
    if (i >= a.N) return;
    if (i >= a.conditioned) {
        typename Gaussian::StillParameters raw{};
        load_still(a, i, raw);
        store_still(typename Gaussian::Still(raw), a.means, out, i);
        return;
    }
    typename Gaussian::Parameters raw{};
    load(a, i, raw);
    store(Gaussian(raw, view_of(a)).observe(), out, i);
}

template <template <class> class Model, class Args, class Given, class Grads>
__global__ void slice_backward_kernel(Args a, Given grads, Grads out) {
    using Gaussian = Model<float>;
    const int64_t i = global_thread();
    if (i >= a.N) return;
    typename Gaussian::Seen given;
    load(grads, i, given);
    if (i >= a.conditioned) {
        typename Gaussian::StillParameters raw{}, g{};
        load_still(a, i, raw);
        still_vjp(typename Gaussian::Still(raw), given, g);
        add_still(g, out, i);
        add_row(given.mean, out.means, i);
        return;
    }
    typename Gaussian::Parameters raw{}, g{};
    load(a, i, raw);
    Gaussian(raw, view_of(a)).vjp(given, g);
    add(g, out, i);
}

template <template <class> class Model, class Args, class Slice>
void slice(const Args& a, const Slice& out, Stream stream) {
    if (a.N > 0) launch(slice_kernel<Model, Args, Slice>, small_blocks(a.N), SMALL_BLOCK, stream, a, out);
}

template <template <class> class Model, class Args, class Given, class Grads>
void slice_backward(const Args& a, const Given& grads, const Grads& out, Stream stream) {
    if (a.N == 0) return;
    launch(slice_backward_kernel<Model, Args, Given, Grads>, small_blocks(a.N), SMALL_BLOCK, stream, a, grads, out);
}

}  // namespace

void slice_direct(const DirectArgs& a, const Observation& out, Stream stream) { slice<DirectGaussian>(a, out, stream); }

void slice_direct_backward(const DirectArgs& a, const ObservationGrads& grads, const DirectGrads& out, Stream stream) {
    slice_backward<DirectGaussian>(a, grads, out, stream);
}

void slice_direct_beta(const DirectBetaArgs& a, const BetaSlice& out, Stream stream) {
    a.times ? slice<Beta4>(a, out, stream) : slice<Beta3>(a, out, stream);
}

void slice_direct_beta_backward(const DirectBetaArgs& a, const BetaSliceGrads& grads, const DirectBetaGrads& out,
                                Stream stream) {
    a.times ? slice_backward<Beta4>(a, grads, out, stream) : slice_backward<Beta3>(a, grads, out, stream);
}

void slice_free_time(const FreeTimeArgs& a, const Observation& out, Stream stream) {
    a.plateaus ? slice<SharpTimeGaussian>(a, out, stream) : slice<FreeTimeGaussian>(a, out, stream);
}

void slice_free_time_backward(const FreeTimeArgs& a, const ObservationGrads& grads, const FreeTimeGrads& out,
                              Stream stream) {
    a.plateaus ? slice_backward<SharpTimeGaussian>(a, grads, out, stream)
               : slice_backward<FreeTimeGaussian>(a, grads, out, stream);
}

}  // namespace gsb::cuda
