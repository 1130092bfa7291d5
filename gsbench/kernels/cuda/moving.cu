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

__device__ ViewPoint view_of(const DirectArgs& a, int64_t view) {
    const float* center = a.center + view * 3;
    return {{center[0], center[1], center[2]}, a.time[view]};
}

// The parameters of a static Gaussian, of dGS or FreeTimeGS.
template <class Args>
__device__ void load_still(const Args& a, int64_t row, int64_t i, StaticParameters<float>& p) {
    load_row(a.scales, row, p.scales);
    load_row(a.quats, row, p.quat);
    p.opacity = a.opacities[i];
}

// This and the functions `add` add to the gradients of raw parameters other than the opacity.
template <class Grads>
__device__ void add_still(const StaticParameters<float>& g, const Grads& out, int64_t row) {
    add_row(g.scales, out.scales, row);
    add_row(g.quat, out.quats, row);
}

__device__ void load(const DirectArgs& a, int64_t row, int64_t i, DirectParameters<float>& p) {
    load_still(a, row, i, p.still);
    load_row(a.means, row, p.mean);
    load_row(a.directions, row, p.direction);
    p.time = a.times[row];
    load_row(a.precision, row, p.motion.precision);
    load_row(a.coupling, row, p.motion.coupling);
    load_row(a.shares, row, p.shares);
}

__device__ void add(const DirectParameters<float>& g, const DirectGrads& out, int64_t row) {
    add_still(g.still, out, row);
    add_row(g.mean, out.means, row);
    add_row(g.direction, out.directions, row);
    out.times[row] += g.time;
    add_row(g.motion.precision, out.precision, row);
    add_row(g.motion.coupling, out.coupling, row);
    add_row(g.shares, out.shares, row);
}

__device__ void store_still(const StaticGaussian<float>& seen, const float* means, int64_t row, const Observation& out,
                            int64_t i) {
    store_static(seen, means, row, out, i);
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

__device__ ViewPoint view_of(const DirectBetaArgs& a, int64_t view) {
    const float* center = a.center + view * 3;
    return {{center[0], center[1], center[2]}, a.time ? a.time[view] : 0.0f};
}

// The first entry of `betas` belongs to the profile, the others to the opacity factor.
__device__ void load_still(const DirectBetaArgs& a, int64_t row, int64_t i, StaticBetaParameters<float>& p) {
    load_row(a.scales, row, p.scales);
    load_row(a.skew, row, p.skew);
    p.opacity = a.opacities[i];
    p.beta = a.betas[row * (a.times ? 5 : 4)];
}

__device__ void add_still(const StaticBetaParameters<float>& g, const DirectBetaGrads& out, int64_t row) {
    add_row(g.scales, out.scales, row);
    add_row(g.skew, out.skew, row);
    out.betas[row * (out.times ? 5 : 4)] += g.beta;
}

template <int K>
__device__ void load(const DirectBetaArgs& a, int64_t row, int64_t i, DirectBetaParameters<float, K>& p) {
    load_still(a, row, i, p.still);
    load_row(a.means, row, p.mean);
    load_row(a.directions, row, p.direction);
    if constexpr (K > 3) p.time = a.times[row];
    load_row(a.precision, row, p.motion.precision);
    load_row(a.coupling, row, p.motion.coupling);
    GSB_UNROLL for (int k = 0; k < K; ++k) p.betas[k] = a.betas[row * (1 + K) + 1 + k];
}

template <int K>
__device__ void add(const DirectBetaParameters<float, K>& g, const DirectBetaGrads& out, int64_t row) {
    add_still(g.still, out, row);
    add_row(g.mean, out.means, row);
    add_row(g.direction, out.directions, row);
    if constexpr (K > 3) out.times[row] += g.time;
    add_row(g.motion.precision, out.precision, row);
    add_row(g.motion.coupling, out.coupling, row);
    GSB_UNROLL for (int k = 0; k < K; ++k) out.betas[row * (1 + K) + 1 + k] += g.betas[k];
}

__device__ void store_still(const StaticBetaGaussian<float>& seen, const float* means, int64_t row,
                            const BetaSlice& out, int64_t i) {
    store_static(seen, means, row, Observation{out.means, out.factors, out.opacities}, i);
    out.shapes[i] = seen.shape;
}

__device__ void still_vjp(const StaticBetaGaussian<float>& still, const ObservedBeta<float>& g,
                          StaticBetaParameters<float>& out) {
    still.vjp(g.factor, g.opacity, g.shape, out);
}

// ---- FreeTimeGS

__device__ ViewPoint view_of(const FreeTimeArgs& a, int64_t view) { return {{}, a.time[view]}; }

__device__ void load(const FreeTimeArgs& a, int64_t row, int64_t i, FreeTimeParameters<float>& p) {
    load_still(a, row, i, p.still);
    load_row(a.means, row, p.mean);
    p.time = a.times[row];
    p.duration = a.durations[row];
    load_row(a.velocities, row, p.velocity);
}

__device__ void add(const FreeTimeParameters<float>& g, const FreeTimeGrads& out, int64_t row) {
    add_still(g.still, out, row);
    add_row(g.mean, out.means, row);
    out.times[row] += g.time;
    out.durations[row] += g.duration;
    add_row(g.velocity, out.velocities, row);
}

// ---- SharpTimeGS

__device__ void load(const FreeTimeArgs& a, int64_t row, int64_t i, SharpTimeParameters<float>& p) {
    load(a, row, i, static_cast<FreeTimeParameters<float>&>(p));
    p.plateau = a.plateaus[row];
}

__device__ void add(const SharpTimeParameters<float>& g, const FreeTimeGrads& out, int64_t row) {
    add(static_cast<const FreeTimeParameters<float>&>(g), out, row);
    out.plateaus[row] += g.plateau;
}

// ---- all of them

template <template <class> class Model, class Args, class Slice>
__global__ void slice_kernel(Args a, Slice out) {
    using Gaussian = Model<float>;
    const int64_t i = global_thread();
    if (i >= a.N) return;
    for (int64_t view = 0; view < a.V; ++view) {
        const int64_t row = raw_row(a, view, i), at = view * a.N + i;
        if (i >= a.conditioned) {
            typename Gaussian::StillParameters raw{};
            load_still(a, row, i, raw);
            store_still(typename Gaussian::Still(raw), a.means, row, out, at);
            continue;
        }
        typename Gaussian::Parameters raw{};
        load(a, row, i, raw);
        store(Gaussian(raw, view_of(a, view)).observe(), out, at);
    }
}

template <template <class> class Model, class Args, class Given, class Grads>
__global__ void slice_backward_kernel(Args a, Given grads, Grads out) {
    using Gaussian = Model<float>;
    const int64_t i = global_thread();
    if (i >= a.N) return;
    typename Gaussian::Parameters sum{};
    for (int64_t view = 0; view < a.V; ++view) {
        const int64_t row = raw_row(a, view, i);
        typename Gaussian::Seen given;
        load(grads, view * a.N + i, given);
        typename Gaussian::Parameters g{};  // of a static row mostly zero
        if (i >= a.conditioned) {
            typename Gaussian::StillParameters raw{};
            load_still(a, row, i, raw);
            still_vjp(typename Gaussian::Still(raw), given, g.still);
            GSB_UNROLL for (int k = 0; k < 3; ++k) g.mean[k] = given.mean[k];
        } else {
            typename Gaussian::Parameters raw{};
            load(a, row, i, raw);
            Gaussian(raw, view_of(a, view)).vjp(given, g);
        }
        accumulate(sum, g);
        if (a.raw_per_view) add(g, out, row);
    }
    if (!a.raw_per_view) add(sum, out, i);
    out.opacities[i] += sum.still.opacity;
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
