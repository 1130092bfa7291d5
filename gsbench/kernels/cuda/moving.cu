// Slices of 3D Gaussians that move and fade (dGS, dBS, FreeTimeGS, SharpTimeGS) and their gradients, one Gaussian per thread.
// math/direct.h, math/direct_beta.h, math/free_time.h and math/sharp_time.h have the formulas.
#include "../math/direct.h"
#include "../math/direct_beta.h"
#include "../math/free_time.h"
#include "../math/sharp_time.h"

#include "rows.h"

namespace gsb::cuda {
namespace {

template <class T>
using Beta3 = DirectBetaGaussian<T, 3>;  // without time
template <class T>
using Beta4 = DirectBetaGaussian<T, 4>;

template <template <class> class Model, class Args, class Slice>
__global__ void slice_kernel(Args a, Slice out) {
    using Gaussian = Model<float>;
    const int64_t i = global_thread();
    if (i >= a.N) return;
    for (int64_t view = 0; view < a.V; ++view) {
        const int64_t row = raw_row(a, view, i), at = view * a.N + i;
        if (i >= a.conditioned) {
            const auto raw = load_raw<typename Gaussian::StillParameters>(a, row, i);
            store_static(typename Gaussian::Still(raw), a.means, row, out, at);
            continue;
        }
        typename Gaussian::Parameters raw{};
        raw.each(a, LoadRow{row});
        raw.still.opacity = a.opacities[i];
        store_observed(Gaussian(raw, view_of(a, view)).observe(), out, at);
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
        const typename Gaussian::Seen given = load_observed(grads, view * a.N + i);
        typename Gaussian::Parameters g{};  // of a static row mostly zero
        if (i >= a.conditioned) {
            const auto raw = load_raw<typename Gaussian::StillParameters>(a, row, i);
            still_vjp(typename Gaussian::Still(raw), given, g.still);
            GSB_UNROLL for (int k = 0; k < 3; ++k) g.mean[k] = given.mean[k];
        } else {
            typename Gaussian::Parameters raw{};
            raw.each(a, LoadRow{row});
            raw.still.opacity = a.opacities[i];
            Gaussian(raw, view_of(a, view)).vjp(given, g);
        }
        accumulate(sum, g);
        if (a.raw_per_view) g.each(out, AddRow{row});
    }
    if (!a.raw_per_view) sum.each(out, AddRow{i});
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
