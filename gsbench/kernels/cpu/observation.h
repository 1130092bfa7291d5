// Sixteen sliced Gaussians to the arrays of a slice, and their gradients from those given.
#pragma once

#include "../math/triangular.h"

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

// Whether a view shows none of them.
GSB_HD inline bool is_zero(const ObservationGrads& given, int64_t i, int n) {
    return all_zero(given.opacities, 1, i, n) && all_zero(given.means, 3, i, n) && all_zero(given.factors, 9, i, n);
}

}  // namespace GSB_ISA
}  // namespace gsb
