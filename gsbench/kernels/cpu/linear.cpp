// A layer of a network, y = W x + b with or without ReLU, for the rows x of an array, and its gradients.
//
// Every number of y is one sum, which starts at the bias and adds the inputs in order; gradients of the weights are
// summed by chunks of rows, and the chunks in order. So the bits depend neither on threads nor on the size of a tile.
// Rows whose gradient is zero, such as those of Gaussians behind others, are left out of the backward pass.
#include "buffer.h"
#include "isa.h"
#include "matrices.h"
#include "rows.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int64_t CHUNK = 256;  // rows, which stay in cache
// Writes the columns from `column` on of the rows row(0), row(1), .. to a panel, with zeros beside the last column.
template <class Row>
void fill_panel(Row row, int64_t rows, int column, int columns, float* panel) {
    for (int64_t i = 0; i < rows; ++i) {
        GSB_UNROLL for (int v = 0; v < TILE_VECTORS; ++v) {
            const int at = column + v * LANES, n = lanes_from(at, columns);
            (n > 0 ? load_some(row(i) + at, n) : Vec(0.0f)).store(panel + i * PANEL + v * LANES);
        }
    }
}

// Writes the panels of W^T, [K, C] -> [panels][C][PANEL].
void fill_transposed(const LinearArgs& a, Buffer<float>& panels) {
    panels.zero();
    for (int k = 0; k < a.K; ++k) {
        float* column = panels.data() + k / PANEL * PANEL * a.C + k % PANEL;
        for (int c = 0; c < a.C; ++c) column[c * PANEL] = a.weight[k * a.C + c];
    }
}

// Writes the gradients of W x + b in `count` rows to G [count, K]: with ReLU, zero where y is zero.
void before_relu(const LinearArgs& a, const float* y, const float* g, const int32_t* rows, int64_t count, float* G) {
    for (int64_t i = 0; i < count; ++i) {
        const int64_t at = int64_t{rows[i]} * a.K;
        for (int k = 0; k < a.K; k += LANES) {
            const int n = lanes_from(k, a.K);
            Vec x = load_some(g + at + k, n);
            if (a.relu) x = select(load_some(y + at + k, n) > Vec(0.0f), x, Vec(0.0f));
            store_first(x, G + i * a.K + k, n);
        }
    }
}

}  // namespace

void linear(const LinearArgs& a, const Layer& out) {
    const int columns = (a.K + PANEL - 1) / PANEL * PANEL;
    Buffer<float> transposed(static_cast<size_t>(int64_t{columns} * a.C));
    fill_transposed(a, transposed);
    const auto begin = at_bias(a.bias, a.K);
#pragma omp parallel for num_threads(a.threads) schedule(dynamic, 1) if (a.N > CHUNK)
    for (int64_t first = 0; first < a.N; first += CHUNK) {
        const int64_t rows = a.N - first < CHUNK ? a.N - first : CHUNK;
        for (int k = 0; k < a.K; k += PANEL) {
            const auto finish = [&](Vec y, int64_t row, int column) {
                const int n = lanes_from(column, a.K);
                if (a.relu) y = select(y < Vec(0.0f), Vec(0.0f), y);  // NaN stays
                if (n > 0) store_first(y, out.y + (first + row) * a.K + column, n);
            };
            multiply({a.x + first * a.C, a.C, 1}, rows, {transposed.data() + k * a.C, PANEL}, a.C, k, a.K, begin, finish);
        }
    }
}

void linear_backward(const LinearArgs& a, const LayerState& state, const LayerGrads& grads, const LinearGrads& out) {
    Buffer<int32_t> rows(static_cast<size_t>(a.N));
    const auto has_gradient = [&](int64_t i) { return !all_zero(grads.y, a.K, i, 1); };
    const int64_t total = rows_where(has_gradient, a.N, a.threads, rows.data());
    const int64_t weights = int64_t{a.K} * a.C, panel_rows = a.K > CHUNK ? a.K : CHUNK;
    // Of each thread: gradients of a chunk before the ReLU, a panel, and gradients of the weights and biases.
    const int64_t scratch_size = (CHUNK + 1) * a.K + panel_rows * PANEL + weights;
    Buffer<float> scratch(static_cast<size_t>(scratch_size * a.threads));
#pragma omp parallel for ordered num_threads(a.threads) schedule(static, 1) if (total > CHUNK)
    for (int64_t first = 0; first < total; first += CHUNK) {
        const int64_t count = total - first < CHUNK ? total - first : CHUNK;
        const int32_t* chunk = rows.data() + first;
        float* G = scratch.data() + scratch_size * thread_index();
        float *panel = G + CHUNK * a.K, *g_weight = panel + panel_rows * PANEL, *g_bias = g_weight + weights;
        before_relu(a, state.y, grads.y, chunk, count, G);
        for (int c = 0; c < a.C; c += PANEL) {
            if (out.x) {
                fill_panel([&](int64_t k) { return a.weight + k * a.C; }, a.K, c, a.C, panel);
                multiply({G, a.K, 1}, count, {panel, PANEL}, a.K, c, a.C, at_zero, [&](Vec x, int64_t row, int column) {
                    const int n = lanes_from(column, a.C);
                    if (n > 0) store_first(x, out.x + int64_t{chunk[row]} * a.C + column, n);
                });
            }
            fill_panel([&](int64_t i) { return a.x + int64_t{chunk[i]} * a.C; }, count, c, a.C, panel);
            multiply({G, 1, a.K}, a.K, {panel, PANEL}, count, c, a.C, at_zero, [&](Vec x, int64_t row, int column) {
                const int n = lanes_from(column, a.C);
                if (n > 0) store_first(x, g_weight + row * a.C + column, n);
            });
        }
        __builtin_memset(g_bias, 0, sizeof(float) * static_cast<size_t>(a.K));
        for (int64_t i = 0; i < count; ++i) {
            for (int k = 0; k < a.K; ++k) g_bias[k] += G[i * a.K + k];
        }
#pragma omp ordered
        {
            for (int64_t k = 0; k < weights; ++k) out.weight[k] += g_weight[k];
            for (int k = 0; k < a.K; ++k) out.bias[k] += g_bias[k];
        }
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
