// AGR, the neural refinement of 7DGS (section 4.3): a few two-layer MLPs change the parameters of every Gaussian, a
// block of Gaussians at a time.
//
// Gaussians lie along the SIMD vectors, so each layer is a product of a small matrix with a tall one that stays in
// cache. Hidden layers are never written to memory; the backward pass computes them again. Blocks are packed, because
// many Gaussians may not change at a given time, and many are not seen in a view.
#include "../math/awake.h"
#include "buffer.h"
#include "isa.h"
#include "rows.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int BLOCK = 128;             // Gaussians
constexpr int64_t TASK = 8 * BLOCK;    // of the forward pass
constexpr int64_t CHUNK = 32 * BLOCK;  // a task of the backward pass; the weights' gradients are summed by chunks
// The tile sizes of `product` and `outer`: as many sums as there are registers.
#if defined(__AVX512F__)
constexpr int TILE_ROWS = 8, TILE_SUMS = 16, OUTER_ROWS = 4;
#else
constexpr int TILE_ROWS = 4, TILE_SUMS = 4, OUTER_ROWS = 1;
#endif

// Computes finish(start + W X) for R rows of W and V vectors of Gaussians, in which `start` is the bias, zero or `out`.
// Rows of X and out are BLOCK floats apart.
template <int R, int V, class Finish>
GSB_HD inline void product_tile(const float* W, int inner, const float* bias, bool add, const float* X, float* out,
                                int at, Finish finish) {
    Vec sums[R][V];
    GSB_UNROLL for (int r = 0; r < R; ++r) {
        GSB_UNROLL for (int v = 0; v < V; ++v) {
            sums[r][v] = add ? Vec::load(out + at + r * BLOCK + v * LANES) : Vec(bias ? bias[r] : 0.0f);
        }
    }
    for (int k = 0; k < inner; ++k) {
        Vec x[V];
        GSB_UNROLL for (int v = 0; v < V; ++v) x[v] = Vec::load(X + k * BLOCK + v * LANES);
        GSB_UNROLL for (int r = 0; r < R; ++r) {
            const Vec w(W[r * inner + k]);
            GSB_UNROLL for (int v = 0; v < V; ++v) sums[r][v] += x[v] * w;
        }
    }
    GSB_UNROLL for (int r = 0; r < R; ++r) {
        GSB_UNROLL for (int v = 0; v < V; ++v) {
            const int place = at + r * BLOCK + v * LANES;
            finish(sums[r][v], place).store(out + place);
        }
    }
}

// Returns the number of vectors of Gaussians in a tile of R rows, a power of two.
constexpr int vectors_beside(int R) {
    int V = 1;
    while (2 * V * R <= TILE_SUMS && 2 * V * LANES <= BLOCK) V *= 2;
    return V;
}

// Computes the product for the rows of W [rows, inner] from `first` on. Rows that do not fill a tile get a tile with
// fewer rows and more Gaussians: each sum waits for the previous addition, and the other sums continue in the meantime.
template <int R = TILE_ROWS, class Finish>
void product(const float* W, int rows, int inner, const float* bias, bool add, const float* X, float* out,
             Finish finish, int first = 0) {
    constexpr int V = vectors_beside(R);
    for (; first + R <= rows; first += R) {
        for (int v = 0; v < BLOCK; v += V * LANES) {
            product_tile<R, V>(W + first * inner, inner, bias ? bias + first : nullptr, add, X + v, out,
                               first * BLOCK + v, finish);
        }
    }
    if constexpr (R > 1) {
        if (first < rows) product<R - 1>(W, rows, inner, bias, add, X, out, finish, first);
    }
}

// Computes out[r][c] += the sum over the block of A[r] B[c], for R rows of A and four rows of B.
template <int R>
GSB_HD inline void outer_tile(const float* A, const float* B, int stride, float* out) {
    Vec sums[R][4];
    GSB_UNROLL for (int r = 0; r < R; ++r) {
        GSB_UNROLL for (int c = 0; c < 4; ++c) sums[r][c] = Vec(0.0f);
    }
    for (int v = 0; v < BLOCK; v += LANES) {
        Vec b[4];
        GSB_UNROLL for (int c = 0; c < 4; ++c) b[c] = Vec::load(B + c * BLOCK + v);
        GSB_UNROLL for (int r = 0; r < R; ++r) {
            const Vec a = Vec::load(A + r * BLOCK + v);
            GSB_UNROLL for (int c = 0; c < 4; ++c) sums[r][c] += a * b[c];
        }
    }
    GSB_UNROLL for (int r = 0; r < R; ++r) {
        alignas(16) float totals[4];
        sum4(sums[r][0], sums[r][1], sums[r][2], sums[r][3], totals);
        for (int c = 0; c < 4; ++c) out[r * stride + c] += totals[c];
    }
}

// Computes the same for all rows; `columns` is a multiple of four. Rows of out are `stride` floats apart.
template <int R = OUTER_ROWS>
void outer(const float* A, int rows, const float* B, int columns, float* out, int stride, int first = 0) {
    for (; first + R <= rows; first += R) {
        for (int c = 0; c < columns; c += 4) {
            outer_tile<R>(A + first * BLOCK, B + c * BLOCK, stride, out + first * stride + c);
        }
    }
    if constexpr (R > 1) {
        if (first < rows) outer<R - 1>(A, rows, B, columns, out, stride, first);
    }
}

void add_row_sums(const float* A, int rows, float* out) {
    for (int r = 0; r < rows; ++r) {
        Vec total(0.0f);
        for (int v = 0; v < BLOCK; v += LANES) total += Vec::load(A + r * BLOCK + v);
        out[r] += sum(total);
    }
}

void transpose(const float* A, int rows, int columns, float* out) {
    for (int r = 0; r < rows; ++r) {
        for (int c = 0; c < columns; ++c) out[c * rows + r] = A[r * columns + c];
    }
}

// A block of up to BLOCK Gaussians, given as `rows` relative to `first`.
struct Block {
    int64_t first;
    const int32_t* rows;
    int count;

    GSB_HD int64_t at(int i) const { return first + rows[i]; }
    // Returns whether the sixteen rows from the i-th on are adjacent.
    GSB_HD bool is_whole(int i) const { return i + LANES <= count && rows[i + LANES - 1] - rows[i] == LANES - 1; }
};

// Calls f<W>() for the width of an array; the compiler knows the widths that the models have.
template <class F>
GSB_HD inline void with_width(int width, F f) {
    switch (width) {
        case 1: return f.template operator()<1>();
        case 3: return f.template operator()<3>();
        case 4: return f.template operator()<4>();
        case 6: return f.template operator()<6>();
        case 7: return f.template operator()<7>();
        case 9: return f.template operator()<9>();
        case 12: return f.template operator()<12>();
        default: return f.template operator()<0>();
    }
}

// Calls whole<W>(i) for each sixteen adjacent rows of a block, from its i-th on, and one(i) for each other row.
template <class Whole, class One>
GSB_HD inline void each_row(const Block& block, int width, Whole whole, One one) {
    with_width(width, [&]<int W>() {
        for (int i = 0; i < block.count; i += LANES) {
            if constexpr (W > 0) {
                if (block.is_whole(i)) {
                    whole.template operator()<W>(i);
                    continue;
                }
            }
            for (int k = i; k < i + lanes_from(i, block.count); ++k) one(k);
        }
    });
}

// Loads the block's rows of an array [N, width], transposed: `width` rows of BLOCK floats, with zeros after the block's
// end.
void load_block(const Block& block, const float* array, int width, float* out) {
    for (int k = 0; k < width; ++k) {
        for (int i = block.count; i < BLOCK; ++i) out[k * BLOCK + i] = 0.0f;
    }
    const auto whole = [&]<int W>(int i) {
        Vec columns[W];
        load_columns(array + block.at(i) * W, columns);
        GSB_UNROLL for (int k = 0; k < W; ++k) columns[k].store(out + k * BLOCK + i);
    };
    each_row(block, width, whole, [&](int i) {
        const float* row = array + block.at(i) * width;
        for (int k = 0; k < width; ++k) out[k * BLOCK + i] = row[k];
    });
}

// Stores the block's rows of `array` plus the `width` rows at `moved` to another array.
void store_block(const Block& block, const float* moved, const float* array, int width, float* out) {
    const auto whole = [&]<int W>(int i) {
        Vec columns[W];
        load_columns(array + block.at(i) * W, columns);
        GSB_UNROLL for (int k = 0; k < W; ++k) columns[k] += Vec::load(moved + k * BLOCK + i);
        store_columns(columns, out + block.at(i) * W);
    };
    each_row(block, width, whole, [&](int i) {
        const int64_t at = block.at(i) * width;
        for (int k = 0; k < width; ++k) out[at + k] = array[at + k] + moved[k * BLOCK + i];
    });
}

// Loads the block's rows of the first `count` arrays, one array below the other.
void load_blocks(const RefineArgs& a, const Block& block, const float* const* arrays, int count, float* out) {
    for (int i = 0; i < count; ++i) {
        load_block(block, arrays[i], a.value_widths[i], out);
        out += a.value_widths[i] * BLOCK;
    }
}

// Stores the block's rows of the first `count` arrays plus `moved` to other arrays.
void store_blocks(const RefineArgs& a, const Block& block, const float* moved, const float* const* arrays, int count,
                  float* const* out) {
    for (int i = 0; i < count; ++i) {
        store_block(block, moved, arrays[i], a.value_widths[i], out[i]);
        moved += a.value_widths[i] * BLOCK;
    }
}

// Copies row i of the first `count` arrays, which AGR does not change.
void copy_row(const RefineArgs& a, const float* const* arrays, int count, float* const* out, int64_t i) {
    for (int k = 0; k < count; ++k) {
        const int width = a.value_widths[k];
        for (int c = 0; c < width; ++c) out[k][i * width + c] = arrays[k][i * width + c];
    }
}

// Copies the rows of the first `count` arrays that AGR never changes.
void copy_rest(const RefineArgs& a, const float* const* arrays, int count, float* const* out) {
    for (int i = 0; i < count; ++i) copy_rows(arrays[i], out[i], a.value_widths[i], a.refined, a.N);
}

constexpr auto as_it_is = [](Vec x, int) { return x; };

void hidden_layer(const RefineArgs& a, int network, const float* X, float* H) {
    product(a.weight_in + network * HIDDEN * a.features, HIDDEN, a.features, a.bias_in + network * HIDDEN,
            false, X, H, [](Vec x, int) { return max(x, Vec(0.0f)); });
}

// The layout of the gradients of all weights: the number of floats, and the offset of each part.
struct WeightLayout {
    int weight_in, bias_in, weight_out, bias_out, size;

    explicit WeightLayout(const RefineArgs& a) {
        const int rows = a.networks * HIDDEN;
        weight_in = 0;  // kept transposed: [features][rows]
        bias_in = weight_in + a.features * rows;
        weight_out = bias_in + rows;
        bias_out = weight_out + a.outputs * HIDDEN;
        size = bias_out + a.outputs;
    }
};

struct Scratch {
    float *X, *g_X, *H, *g_H, *G;

    static size_t size(const RefineArgs& a) {
        return static_cast<size_t>(2 * a.features + 1 + 2 * HIDDEN + a.outputs) * BLOCK;
    }
    Scratch(const RefineArgs& a, float* memory) {
        X = memory;
        g_X = X + (a.features + 1) * BLOCK;
        H = g_X + a.features * BLOCK;
        g_H = H + HIDDEN * BLOCK;
        G = g_H + HIDDEN * BLOCK;
    }
};

void backward_block(const RefineArgs& a, const Block& block, const WeightLayout& layout, const float* weight_in_T,
                    const float* weight_out_T, const float* const* grads, float* const* g_features, float* g_weights,
                    const Scratch& s) {
    load_blocks(a, block, a.values, a.networks - 1, s.X);
    // The last feature is one: its weights are the biases, whose gradient follows that of weight_in.
    for (int v = 0; v < BLOCK; v += LANES) Vec(1.0f).store(s.X + a.features * BLOCK + v);
    load_blocks(a, block, grads, a.arrays, s.G);
    int output = 0;
    for (int network = 0; network < a.networks; ++network) {
        const int width = a.widths[network];
        const float* G = s.G + output * BLOCK;
        hidden_layer(a, network, s.X, s.H);
        outer(G, width, s.H, HIDDEN, g_weights + layout.weight_out + output * HIDDEN, HIDDEN);
        product(weight_out_T + output * HIDDEN, HIDDEN, width, nullptr, false, G, s.g_H,
                [&](Vec x, int at) { return select(Vec::load(s.H + at) > Vec(0.0f), x, Vec(0.0f)); });
        outer(s.X, a.features + 1, s.g_H, HIDDEN, g_weights + layout.weight_in + network * HIDDEN,
              a.networks * HIDDEN);
        product(weight_in_T + network * HIDDEN * a.features, a.features, HIDDEN, nullptr, network > 0,
                s.g_H, s.g_X, as_it_is);
        output += width;
    }
    add_row_sums(s.G, a.outputs, g_weights + layout.bias_out);
    store_blocks(a, block, s.g_X, grads, a.networks - 1, g_features);
}

bool has_gradient(const RefineArgs& a, const float* const* grads, int64_t i) {
    for (int k = 0; k < a.arrays; ++k) {
        const float* row = grads[k] + i * a.value_widths[k];
        for (int c = 0; c < a.value_widths[k]; c += LANES) {
            const Vec g = load_some(row + c, lanes_from(c, a.value_widths[k]));
            if (any(!(g == Vec(0.0f)))) return true;
        }
    }
    return false;
}

// Writes the rows of [first, last) that AGR changes and that have a gradient, relative to `first`, and returns their
// number. For the other rows the given gradient is copied to the features' gradient.
int rows_with_gradient(const RefineArgs& a, const float* const* grads, int64_t first, int64_t last,
                       float* const* g_features, int32_t* rows) {
    int count = 0;
    for (int64_t i = first; i < last; ++i) {
        if (is_awake(a.intervals, a.time, i) && has_gradient(a, grads, i)) {
            rows[count++] = static_cast<int32_t>(i - first);
        } else {
            copy_row(a, grads, a.networks - 1, g_features, i);
        }
    }
    return count;
}

void refine_block(const RefineArgs& a, const Block& block, float* const* out, const Scratch& s) {
    load_blocks(a, block, a.values, a.networks - 1, s.X);
    int output = 0;
    for (int network = 0; network < a.networks; ++network) {
        hidden_layer(a, network, s.X, s.H);
        product(a.weight_out + output * HIDDEN, a.widths[network], HIDDEN, a.bias_out + output, false, s.H,
                s.G + output * BLOCK, as_it_is);
        output += a.widths[network];
    }
    store_blocks(a, block, s.G, a.values, a.arrays, out);
}

// Writes the rows of [first, last) that AGR changes, relative to `first`, and returns their number; the others are
// copied.
int rows_awake(const RefineArgs& a, int64_t first, int64_t last, float* const* out, int32_t* rows) {
    int count = 0;
    for (int64_t i = first; i < last; ++i) {
        if (is_awake(a.intervals, a.time, i)) {
            rows[count++] = static_cast<int32_t>(i - first);
        } else {
            copy_row(a, a.values, a.arrays, out, i);
        }
    }
    return count;
}

}  // namespace

void refine(const RefineArgs& a, const Refined& out) {
    const size_t scratch_size = Scratch::size(a);
    Buffer<float> scratch(scratch_size * static_cast<size_t>(a.threads));
#pragma omp parallel for num_threads(a.threads) schedule(dynamic, 1) if (a.refined > CHUNK)
    for (int64_t first = 0; first < a.refined; first += TASK) {
        const Scratch s(a, scratch.data() + scratch_size * static_cast<size_t>(thread_index()));
        int32_t rows[TASK];
        const int64_t last = first + TASK < a.refined ? first + TASK : a.refined;
        const int count = rows_awake(a, first, last, out.values, rows);
        for (int i = 0; i < count; i += BLOCK) {
            refine_block(a, {first, rows + i, count - i < BLOCK ? count - i : BLOCK}, out.values, s);
        }
    }
    copy_rest(a, a.values, a.arrays, out.values);
}

void refine_backward(const RefineArgs& a, const RefinedGrads& grads, const RefineGrads& out) {
    const WeightLayout layout(a);
    const size_t rows = static_cast<size_t>(a.networks) * HIDDEN, width = static_cast<size_t>(a.features);
    Buffer<float> weight_in_T(rows * width), weight_out_T(static_cast<size_t>(a.outputs) * HIDDEN);
    for (int network = 0, output = 0; network < a.networks; output += a.widths[network++]) {
        transpose(a.weight_in + network * HIDDEN * a.features, HIDDEN, a.features,
                  weight_in_T.data() + network * HIDDEN * a.features);
        transpose(a.weight_out + output * HIDDEN, a.widths[network], HIDDEN, weight_out_T.data() + output * HIDDEN);
    }
    const int64_t chunks = (a.refined + CHUNK - 1) / CHUNK;
    const size_t scratch_size = Scratch::size(a), weights = static_cast<size_t>(layout.size);
    Buffer<float> scratch(scratch_size * static_cast<size_t>(a.threads));
    Buffer<float> partial(weights * static_cast<size_t>(chunks));
    partial.zero();
#pragma omp parallel for num_threads(a.threads) schedule(dynamic, 1) if (chunks > 1)
    for (int64_t chunk = 0; chunk < chunks; ++chunk) {
        const Scratch s(a, scratch.data() + scratch_size * static_cast<size_t>(thread_index()));
        int32_t packed[CHUNK];
        const int64_t first = chunk * CHUNK, last = first + CHUNK < a.refined ? first + CHUNK : a.refined;
        const int count = rows_with_gradient(a, grads.values, first, last, out.values, packed);
        for (int i = 0; i < count; i += BLOCK) {
            const Block block{first, packed + i, count - i < BLOCK ? count - i : BLOCK};
            backward_block(a, block, layout, weight_in_T.data(), weight_out_T.data(), grads.values, out.values,
                           partial.data() + weights * static_cast<size_t>(chunk), s);
        }
    }
    copy_rest(a, grads.values, a.networks - 1, out.values);
    Buffer<float> total(weights);
    total.zero();
    for (size_t chunk = 0; chunk < static_cast<size_t>(chunks); ++chunk) {
        for (size_t k = 0; k < weights; ++k) total[k] += partial[chunk * weights + k];
    }
    transpose(total.data() + layout.weight_in, a.features, static_cast<int>(rows), out.weight_in);
    __builtin_memcpy(out.bias_in, total.data() + layout.bias_in, rows * sizeof(float));
    __builtin_memcpy(out.weight_out, total.data() + layout.weight_out,
                     static_cast<size_t>(a.outputs) * HIDDEN * sizeof(float));
    __builtin_memcpy(out.bias_out, total.data() + layout.bias_out, static_cast<size_t>(a.outputs) * sizeof(float));
}

}  // namespace GSB_ISA
}  // namespace gsb
