// How parameters map to entries below the diagonal of a triangular factor; gsbench.models.factors lists the same forms
// in the same order.
#pragma once

namespace gsb {

enum class OffDiagonal : int {
    relative,    // `shape` in units of its row's diagonal entry, `motion` and `coupling` unchanged
    raw,         // all unchanged
    row_scaled,  // all (2 sigmoid(x) - 1) times the diagonal entry of their row
};

}  // namespace gsb
