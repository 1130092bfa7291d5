// Products of matrices with small tiles of sums, each of which is added in order: the bits of a sum do not depend on the
// tile.
#pragma once

#include <cstdint>

#include "buffer.h"
#include "rows.h"
#include "simd.h"

namespace gsb {
inline namespace GSB_ISA {

// A tile of a product has as many sums as keep the processor busy: each waits for its previous addition.
#if defined(__AVX512F__)
constexpr int TILE_ROWS = 8, TILE_VECTORS = 2;
#else
constexpr int TILE_ROWS = 4, TILE_VECTORS = 1;
#endif
constexpr int PANEL = TILE_VECTORS * LANES;  // columns

// The left matrix of a product, A[r][i] = start[r * row + i * step].
struct Left {
    const float* start;
    int64_t row, step;
};

// Some columns of the right matrix of a product, B[i][c] = start[i * row + c]; up to fifteen floats behind its last
// column are read.
struct Right {
    const float* start;
    int64_t row;
};

// Adds A B to sums that begin at `begin(column)`, for R rows of A, from row r on, and V vectors of columns of B;
// finish(sum, row, column) stores them.
template <int R, int V, class Begin, class Finish>
GSB_HD inline void multiply_tile(const Left& A, int64_t r, const Right& B, int64_t inner, int column, Begin begin,
                                 Finish finish) {
    const float* a = A.start + r * A.row;
    Vec sums[R][V];
    GSB_UNROLL for (int v = 0; v < V; ++v) {
        const Vec first = begin(column + v * LANES);
        GSB_UNROLL for (int k = 0; k < R; ++k) sums[k][v] = first;
    }
    for (int64_t i = 0; i < inner; ++i) {
        Vec b[V];
        GSB_UNROLL for (int v = 0; v < V; ++v) b[v] = Vec::load(B.start + i * B.row + v * LANES);
        GSB_UNROLL for (int k = 0; k < R; ++k) {
            const Vec x(a[k * A.row + i * A.step]);
            GSB_UNROLL for (int v = 0; v < V; ++v) sums[k][v] += x * b[v];
        }
    }
    GSB_UNROLL for (int k = 0; k < R; ++k) {
        GSB_UNROLL for (int v = 0; v < V; ++v) finish(sums[k][v], r + k, column + v * LANES);
    }
}

// Computes the product for the rows of A from r on and V vectors of columns, R rows at a time, and fewer at the end.
template <int R, int V, class Begin, class Finish>
void multiply_rows(const Left& A, int64_t r, int64_t rows, const Right& B, int64_t inner, int column, Begin begin,
                   Finish finish) {
    for (; r + R <= rows; r += R) multiply_tile<R, V>(A, r, B, inner, column, begin, finish);
    if constexpr (R > 1) multiply_rows<R / 2, V>(A, r, rows, B, inner, column, begin, finish);
}

// Computes the product for `rows` rows of A and the panel B whose first column is `column` of `columns`.
template <class Begin, class Finish>
void multiply(const Left& A, int64_t rows, const Right& B, int64_t inner, int column, int columns, Begin begin,
              Finish finish) {
    if (columns - column > LANES) {
        multiply_rows<TILE_ROWS, TILE_VECTORS>(A, 0, rows, B, inner, column, begin, finish);
    } else {
        multiply_rows<TILE_ROWS, 1>(A, 0, rows, B, inner, column, begin, finish);
    }
}

// Returns a `begin` of sums that start at a bias, and one of sums that start at zero.
inline auto at_bias(const float* bias, int columns) {
    return [=](int column) {
        const int n = lanes_from(column, columns);
        return n > 0 ? load_some(bias + column, n) : Vec(0.0f);
    };
}
constexpr auto at_zero = [](int) { return Vec(0.0f); };

// Writes the indices i below N for which has(i) is true, such as those of Gaussians in front of others, which have a
// gradient, and returns their number.
template <class Has>
int64_t rows_where(Has has, int64_t N, int threads, int32_t* rows) {
    Buffer<bool> is(static_cast<size_t>(N));
#pragma omp parallel for num_threads(threads) schedule(static) if (N > 256)
    for (int64_t i = 0; i < N; ++i) is[static_cast<size_t>(i)] = has(i);
    int64_t count = 0;
    for (int64_t i = 0; i < N; ++i) {
        if (is[static_cast<size_t>(i)]) rows[count++] = static_cast<int32_t>(i);
    }
    return count;
}

}  // namespace GSB_ISA
}  // namespace gsb
