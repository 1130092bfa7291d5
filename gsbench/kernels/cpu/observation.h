// Stores sixteen conditional 3D Gaussians to arrays, and loads their gradients.
#pragma once

#include "../math/beta_slice.h"

#include "buffer.h"
#include "rows.h"

namespace gsb {
inline namespace GSB_ISA {

GSB_HD inline void store(const Observed<Vec>& seen, const Observation& out, int64_t i, int n) {
    scatter_row(seen.mean, out.means, i, n);
    scatter_matrix(seen.factor, out.factors, i, n);
    store_first(seen.opacity, out.opacities + i, n);
}

GSB_HD inline void load(const ObservationGrads& given, int64_t i, int n, Observed<Vec>& out) {
    gather_row(given.means, i, n, out.mean);
    gather_matrix(given.factors, i, n, out.factor);
    out.opacity = load_first(given.opacities + i, n);
}

// Returns whether all given gradients of these Gaussians are zero, for instance because no pixel shows them.
GSB_HD inline bool is_zero(const ObservationGrads& given, int64_t i, int n) {
    return all_zero(given.opacities, 1, i, n) && all_zero(given.means, 3, i, n) && all_zero(given.factors, 9, i, n);
}

GSB_HD inline void store(const ObservedBeta<Vec>& seen, const BetaSlice& out, int64_t i, int n) {
    store(seen, Observation{out.means, out.factors, out.opacities}, i, n);
    store_first(seen.shape, out.shapes + i, n);
}

GSB_HD inline void load(const BetaSliceGrads& given, int64_t i, int n, ObservedBeta<Vec>& out) {
    load(ObservationGrads{given.means, given.factors, given.opacities}, i, n, out);
    out.shape = load_first(given.shapes + i, n);
}

GSB_HD inline bool is_zero(const BetaSliceGrads& given, int64_t i, int n) {
    return is_zero(ObservationGrads{given.means, given.factors, given.opacities}, i, n) &&
           all_zero(given.shapes, 1, i, n);
}

// Calls f(i, n, sums) as each_sixteen(0, end, threads, f) does; f adds to COUNT sums. Their totals do not depend on the
// number of threads, because each task has its own sums.
template <int COUNT, class F>
void sum_sixteens(int64_t end, int threads, double (&totals)[COUNT], F f) {
    const int64_t tasks = (end + FEW - 1) / FEW;
    Buffer<float> parts(static_cast<size_t>(tasks * COUNT));
#pragma omp parallel for num_threads(threads) schedule(static) if (tasks > 1)
    for (int64_t task = 0; task < tasks; ++task) {
        const int64_t last = (task + 1) * FEW < end ? (task + 1) * FEW : end;
        Vec sums[COUNT];
        for (Vec& x : sums) x = Vec(0.0f);
        for (int64_t i = task * FEW; i < last; i += LANES) f(i, lanes_from(i, last), sums);
        for (int k = 0; k < COUNT; ++k) parts[static_cast<size_t>(task * COUNT + k)] = sum(sums[k]);
    }
    for (int k = 0; k < COUNT; ++k) {
        totals[k] = 0.0;
        for (int64_t task = 0; task < tasks; ++task) totals[k] += parts[static_cast<size_t>(task * COUNT + k)];
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
