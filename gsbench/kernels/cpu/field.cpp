// A field that changes Gaussians over time: features of space times samples of planes of time, read by a network of a
// layer and heads, each of two more layers; and its gradients. ReLU is behind all layers but the last ones.
//
// All points of a view share its time, so planes of time are lines to them. A chunk of rows goes through all layers
// while it is in cache. Features and hidden layers are never written to memory; the backward pass computes them again.
// As in linear.cpp, every number is one sum in order, gradients of the weights are summed by chunks, and rows without a
// gradient are left out of the backward pass.
#include "buffer.h"
#include "isa.h"
#include "lines.h"
#include "matrices.h"
#include "rows.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int64_t CHUNK = 128;  // rows

// A row-major matrix. Its rows are an odd number of cache lines long: else a column would use a part of the cache only.
struct Matrix {
    float* start;
    int64_t row;

    Left as_it_is(int column = 0) const { return {start + column, row, 1}; }
    Left transposed(int column = 0) const { return {start + column, 1, row}; }
    Right from(int column) const { return {start + column, row}; }
};

int64_t row_length(int columns) { return int64_t{((columns + LANES - 1) / LANES) | 1} * LANES; }

// Memory for matrices, and for what a product reads behind the last column of each.
int64_t floats(int64_t rows, int columns) { return rows * row_length(columns) + LANES; }
Matrix take(float*& memory, int64_t rows, int columns) {
    const Matrix out{memory, row_length(columns)};
    memory += floats(rows, columns);
    return out;
}

// Computes A B for `rows` rows of A and `columns` columns of B from its column `first` on.
template <class Begin, class Finish>
void product(const Left& A, int64_t rows, const Matrix& B, int first, int64_t inner, int columns, Begin begin,
             Finish finish) {
    for (int c = 0; c < columns; c += PANEL) multiply(A, rows, B.from(first + c), inner, c, columns, begin, finish);
}

// Functions that finish the sums of a product of so many columns: they write them to `out`, after ReLU or where
// ReLU had let `hidden` pass. Both are memory whose rows are `row` floats apart.
auto write_to(float* out, int64_t row, int columns) {
    return [=](Vec x, int64_t i, int column) {
        const int n = lanes_from(column, columns);
        if (n > 0) store_first(x, out + i * row + column, n);
    };
}
auto write_relu(const Matrix& out, int columns) {
    return [=, write = write_to(out.start, out.row, columns)](Vec x, int64_t i, int column) {
        write(select(x < Vec(0.0f), Vec(0.0f), x), i, column);  // NaN stays
    };
}
auto write_passed(const Matrix& hidden, const Matrix& out, int first, int columns) {
    return [=, write = write_to(out.start + first, out.row, columns)](Vec x, int64_t i, int column) {
        const int n = lanes_from(column, columns);
        if (n <= 0) return;
        const Vec passed = load_some(hidden.start + i * hidden.row + first + column, n);
        write(select(passed > Vec(0.0f), x, Vec(0.0f)), i, column);
    };
}

void copy_weights(const float* weight, int rows, int columns, const Matrix& out) {
    for (int r = 0; r < rows; ++r) {
        __builtin_memcpy(out.start + r * out.row, weight + r * columns, sizeof(float) * static_cast<size_t>(columns));
    }
}
void transpose_weights(const float* weight, int rows, int columns, const Matrix& out) {
    for (int r = 0; r < rows; ++r) {
        for (int c = 0; c < columns; ++c) out.start[c * out.row + r] = weight[r * columns + c];
    }
}

// The weights as the right matrices of products: transposed for the layers, as they are for their gradients.
struct Weights {
    Buffer<float> memory;
    Matrix first_T, hidden_T, last_T, first, hidden, last;

    explicit Weights(const FieldArgs& a)
        : memory(static_cast<size_t>(floats(a.F, a.H) + floats(a.H, a.heads * a.H) + floats(a.H, a.K) +
                                     floats(a.H, a.F) + floats(a.heads * a.H, a.H) + floats(a.K, a.H))) {
        memory.zero();
        float* next = memory.data();
        transpose_weights(a.first_weight, a.H, a.F, first_T = take(next, a.F, a.H));
        transpose_weights(a.hidden_weight, a.heads * a.H, a.H, hidden_T = take(next, a.H, a.heads * a.H));
        transpose_weights(a.last_weight, a.K, a.H, last_T = take(next, a.H, a.K));
        copy_weights(a.first_weight, a.H, a.F, first = take(next, a.H, a.F));
        copy_weights(a.hidden_weight, a.heads * a.H, a.H, hidden = take(next, a.heads * a.H, a.H));
        copy_weights(a.last_weight, a.K, a.H, last = take(next, a.K, a.H));
    }
};

// Memory of a thread for the layers of a chunk.
struct Layers {
    Matrix first, hidden;

    static int64_t size(const FieldArgs& a) { return floats(CHUNK, a.H) + floats(CHUNK, a.heads * a.H); }
    Layers(const FieldArgs& a, float*& memory)
        : first(take(memory, CHUNK, a.H)), hidden(take(memory, CHUNK, a.heads * a.H)) {}
};

void hidden_layers(const FieldArgs& a, const Weights& w, const Left& x, int64_t rows, const Layers& out) {
    const int hidden = a.heads * a.H;
    product(x, rows, w.first_T, 0, a.F, a.H, at_bias(a.first_bias, a.H), write_relu(out.first, a.H));
    product(out.first.as_it_is(), rows, w.hidden_T, 0, a.H, hidden, at_bias(a.hidden_bias, hidden),
            write_relu(out.hidden, hidden));
}

// Calls f(head, first output, number of outputs) for each head. All outputs have a head, whatever `ends` says.
template <class F>
void for_each_head(const FieldArgs& a, F f) {
    for (int head = 0, first = 0; head < a.heads; ++head) {
        const int end = head + 1 == a.heads || a.ends[head] > a.K ? a.K : a.ends[head] < first ? first : a.ends[head];
        f(head, first, end - first);
        first = end;
    }
}

// The gradients of the weights, and of the lines, by one chunk, one after the other.
struct WeightGrads {
    float *first_weight, *first_bias, *hidden_weight, *hidden_bias, *last_weight, *last_bias, *lines, *end;

    WeightGrads(const FieldArgs& a, const Lines& of_time, float* memory)
        : first_weight(memory),
          first_bias(first_weight + int64_t{a.H} * a.F),
          hidden_weight(first_bias + a.H),
          hidden_bias(hidden_weight + int64_t{a.heads} * a.H * a.H),
          last_weight(hidden_bias + a.heads * a.H),
          last_bias(last_weight + int64_t{a.K} * a.H),
          lines(last_bias + a.K),
          end(lines + of_time.size) {}

    void add_to(const FieldGrads& out, float* g_lines) const {
        const auto add = [](const float* from, const float* end, float* to) {
            for (; from < end; ++from, ++to) *to += *from;
        };
        add(first_weight, first_bias, out.first_weight);
        add(first_bias, hidden_weight, out.first_bias);
        add(hidden_weight, hidden_bias, out.hidden_weight);
        add(hidden_bias, last_weight, out.hidden_bias);
        add(last_weight, last_bias, out.last_weight);
        add(last_bias, lines, out.last_bias);
        add(lines, end, g_lines);
    }
};

void sum_rows(const Matrix& x, int64_t rows, int columns, float* out) {
    __builtin_memset(out, 0, sizeof(float) * static_cast<size_t>(columns));
    for (int64_t i = 0; i < rows; ++i) {
        for (int c = 0; c < columns; ++c) out[c] += x.start[i * x.row + c];
    }
}

}  // namespace

void field(const FieldArgs& a, const Layer& out) {
    const Weights w(a);
    Lines lines(a);
    const int64_t scratch_size = floats(CHUNK, a.F) + Layers::size(a);
    Buffer<float> scratch(static_cast<size_t>(scratch_size * a.threads));
#pragma omp parallel for num_threads(a.threads) schedule(dynamic, 1) if (a.N > CHUNK)
    for (int64_t begin = 0; begin < a.N; begin += CHUNK) {
        const int64_t rows = a.N - begin < CHUNK ? a.N - begin : CHUNK;
        float* memory = scratch.data() + scratch_size * thread_index();
        const Matrix x = take(memory, CHUNK, a.F);
        const Layers layers(a, memory);
        for (int64_t i = 0; i < rows; ++i) lines.features(a, begin + i, x.start + i * x.row);
        hidden_layers(a, w, x.as_it_is(), rows, layers);
        for_each_head(a, [&](int head, int first, int width) {
            product(layers.hidden.as_it_is(head * a.H), rows, w.last_T, first, a.H, width,
                    at_bias(a.last_bias + first, width), write_to(out.y + first * a.N + begin * width, width, width));
        });
    }
}

void field_backward(const FieldArgs& a, const LayerGrads& grads, const FieldGrads& out) {
    Buffer<int32_t> kept(static_cast<size_t>(a.N));
    const auto has_gradient = [&](int64_t i) {
        bool has = false;
        for_each_head(a, [&](int, int first, int width) { has = has || !all_zero(grads.y + first * a.N, width, i, 1); });
        return has;
    };
    const int64_t total = rows_where(has_gradient, a.N, a.threads, kept.data());
    const Weights w(a);
    Lines lines(a);
    Buffer<float> g_lines(static_cast<size_t>(lines.size));
    g_lines.zero();
    const int hidden = a.heads * a.H;
    const int64_t weights = WeightGrads(a, lines, nullptr).end - static_cast<float*>(nullptr);
    const int64_t scratch_size = 2 * Layers::size(a) + floats(CHUNK, a.F) + floats(CHUNK, a.K) + weights;
    Buffer<float> scratch(static_cast<size_t>(scratch_size * a.threads));
#pragma omp parallel for ordered num_threads(a.threads) schedule(static, 1) if (total > CHUNK)
    for (int64_t begin = 0; begin < total; begin += CHUNK) {
        const int64_t count = total - begin < CHUNK ? total - begin : CHUNK;
        const int32_t* rows = kept.data() + begin;
        float* memory = scratch.data() + scratch_size * thread_index();
        const Layers layers(a, memory), g(a, memory);
        const Matrix x = take(memory, CHUNK, a.F), g_y = take(memory, CHUNK, a.K);
        const WeightGrads g_weights(a, lines, memory);
        for (int64_t i = 0; i < count; ++i) {
            lines.features(a, rows[i], x.start + i * x.row);
            for_each_head(a, [&](int, int first, int width) {
                __builtin_memcpy(g_y.start + i * g_y.row + first, grads.y + first * a.N + int64_t{rows[i]} * width,
                                 sizeof(float) * static_cast<size_t>(width));
            });
        }
        hidden_layers(a, w, x.as_it_is(), count, layers);
        for_each_head(a, [&](int head, int first, int width) {
            product(g_y.transposed(first), width, layers.hidden, head * a.H, count, a.H, at_zero,
                    write_to(g_weights.last_weight + first * a.H, a.H, a.H));
            product(g_y.as_it_is(first), count, {w.last.start + first * w.last.row, w.last.row}, 0, width, a.H, at_zero,
                    write_passed(layers.hidden, g.hidden, head * a.H, a.H));
        });
        product(g.hidden.transposed(), hidden, layers.first, 0, count, a.H, at_zero,
                write_to(g_weights.hidden_weight, a.H, a.H));
        product(g.hidden.as_it_is(), count, w.hidden, 0, hidden, a.H, at_zero,
                write_passed(layers.first, g.first, 0, a.H));
        product(g.first.transposed(), a.H, x, 0, count, a.F, at_zero, write_to(g_weights.first_weight, a.F, a.F));
        product(g.first.as_it_is(), count, w.first, 0, a.H, a.F, at_zero, write_to(x.start, x.row, a.F));
        sum_rows(g_y, count, a.K, g_weights.last_bias);
        sum_rows(g.hidden, count, hidden, g_weights.hidden_bias);
        sum_rows(g.first, count, a.H, g_weights.first_bias);
        __builtin_memset(g_weights.lines, 0, sizeof(float) * static_cast<size_t>(lines.size));
        for (int64_t i = 0; i < count; ++i) {
            lines.features_backward(a, rows[i], x.start + i * x.row, out, g_weights.lines);
        }
#pragma omp ordered
        g_weights.add_to(out, g_lines.data());
    }
    lines.for_each(a, out.of_time, g_lines.data(), [&](int n, float* before, float* after, float* line) {
        const Vec g = load_some(line, n), later = g * Vec(lines.time.share);
        add_first(g - later, before, n);
        add_first(later, after, n);
    });
}

}  // namespace GSB_ISA
}  // namespace gsb
