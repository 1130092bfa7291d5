// AGR (7DGS, section 4.3): four perceptrons of two layers move every Gaussian, a block of Gaussians at a time.
//
// Gaussians lie along the vectors, so each layer is a product of a small matrix with a tall one that stays in cache:
// hidden layers are never written to memory, and backward computes them again.
#include "buffer.h"
#include "isa.h"
#include "rows.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int BLOCK = 128;             // Gaussians
constexpr int64_t CHUNK = 32 * BLOCK;  // a task; the weights' gradients are summed by chunks
constexpr int HIDDEN = 64;
#if defined(__AVX512F__)
constexpr int TILE_ROWS = 8, TILE_VECS = 2;  // as many sums as registers hold
#else
constexpr int TILE_ROWS = 4, TILE_VECS = 1;
#endif

// out = (bias | 0 | out) + W X for R rows of W and V vectors of Gaussians. Rows of X and out are BLOCK apart.
template <int R, int V>
GSB_HD inline void product_tile(const float* W, int stride, const float* bias, bool add, const float* X, int inner,
                                float* out) {
    Vec sums[R][V];
    GSB_UNROLL for (int r = 0; r < R; ++r) {
        GSB_UNROLL for (int v = 0; v < V; ++v) {
            sums[r][v] = add ? Vec::load(out + r * BLOCK + v * LANES) : Vec(bias ? bias[r] : 0.0f);
        }
    }
    for (int k = 0; k < inner; ++k) {
        Vec x[V];
        GSB_UNROLL for (int v = 0; v < V; ++v) x[v] = Vec::load(X + k * BLOCK + v * LANES);
        GSB_UNROLL for (int r = 0; r < R; ++r) {
            const Vec w(W[r * stride + k]);
            GSB_UNROLL for (int v = 0; v < V; ++v) sums[r][v] += x[v] * w;
        }
    }
    GSB_UNROLL for (int r = 0; r < R; ++r) {
        GSB_UNROLL for (int v = 0; v < V; ++v) sums[r][v].store(out + r * BLOCK + v * LANES);
    }
}

void product(const float* W, int rows, int inner, const float* bias, bool add, const float* X, float* out) {
    for (int v = 0; v < BLOCK; v += TILE_VECS * LANES) {
        const int whole = rows / TILE_ROWS * TILE_ROWS;
        for (int r = 0; r < whole; r += TILE_ROWS) {
            product_tile<TILE_ROWS, TILE_VECS>(W + r * inner, inner, bias ? bias + r : nullptr, add, X + v, inner,
                                               out + r * BLOCK + v);
        }
        for (int r = whole; r < rows; ++r) {
            product_tile<1, TILE_VECS>(W + r * inner, inner, bias ? bias + r : nullptr, add, X + v, inner,
                                       out + r * BLOCK + v);
        }
    }
}

// out[r][c] += sum over the block of A[r] B[c], for R rows of A and four of B.
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

// `columns` is a multiple of four.
void outer(const float* A, int rows, const float* B, int columns, float* out) {
    const int whole = rows / 4 * 4;
    for (int r = 0; r < whole; r += 4) {
        for (int c = 0; c < columns; c += 4) {
            outer_tile<4>(A + r * BLOCK, B + c * BLOCK, columns, out + r * columns + c);
        }
    }
    for (int r = whole; r < rows; ++r) {
        for (int c = 0; c < columns; c += 4) {
            outer_tile<1>(A + r * BLOCK, B + c * BLOCK, columns, out + r * columns + c);
        }
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

// Rows [first, first + BLOCK) of an array [N, width] as `width` rows of the block; zero past the end.
void load_block(const float* rows, int64_t first, int64_t N, int width, float* out) {
    for (int v = 0; v < BLOCK; v += LANES) {
        const int64_t i = first + v;
        const int n = i >= N ? 0 : lanes_from(i, N);
        for (int k = 0; k < width; ++k) {
            (n ? gather(rows + i * width + k, width, n) : Vec(0.0f)).store(out + k * BLOCK + v);
        }
    }
}

// The block's `width` rows, added to those of `base` [N, width] unless that is null.
void store_block(const float* block, const float* base, int64_t first, int64_t N, int width, float* rows) {
    for (int v = 0; v < BLOCK && first + v < N; v += LANES) {
        const int64_t i = first + v;
        const int n = lanes_from(i, N);
        for (int k = 0; k < width; ++k) {
            const Vec x = Vec::load(block + k * BLOCK + v);
            const int64_t at = i * width + k;
            scatter(base ? x + gather(base + at, width, n) : x, rows + at, width, n);
        }
    }
}

// The first `arrays` of several as rows of the block, one array below the other.
void load_blocks(const RefineArgs& a, const float* const* arrays, int count, int64_t first, float* out) {
    for (int i = 0; i < count; ++i) {
        load_block(arrays[i], first, a.N, a.value_widths[i], out);
        out += a.value_widths[i] * BLOCK;
    }
}

void hidden_layer(const RefineArgs& a, int network, const float* X, float* H) {
    product(a.weight_in + network * HIDDEN * a.features_width, HIDDEN, a.features_width,
            a.bias_in + network * HIDDEN, false, X, H);
    for (int k = 0; k < HIDDEN * BLOCK; k += LANES) max(Vec::load(H + k), Vec(0.0f)).store(H + k);
}

// How many floats the gradients of all weights are, and where each part begins.
struct WeightLayout {
    int weight_in, bias_in, weight_out, bias_out, size;

    // Columns of weight_in's gradient are padded to a multiple of four.
    explicit WeightLayout(const RefineArgs& a) {
        const int rows = a.networks * HIDDEN;
        weight_in = 0;
        bias_in = weight_in + a.features_width * rows;  // kept transposed: [features][rows]
        weight_out = bias_in + rows;
        bias_out = weight_out + a.outputs * HIDDEN;
        size = bias_out + a.outputs;
    }
};

struct Scratch {
    float *X, *g_X, *H, *g_H, *G;

    static size_t size(const RefineArgs& a) {
        return static_cast<size_t>(2 * a.features_width + 2 * HIDDEN + a.outputs) * BLOCK;
    }
    Scratch(const RefineArgs& a, float* memory) {
        X = memory;
        g_X = X + a.features_width * BLOCK;
        H = g_X + a.features_width * BLOCK;
        g_H = H + HIDDEN * BLOCK;
        G = g_H + HIDDEN * BLOCK;
    }
};

void backward_block(const RefineArgs& a, const WeightLayout& layout, const float* weight_in_T,
                    const float* weight_out_T, int64_t first, const float* const* grads, float* const* g_features,
                    float* g_weights, const Scratch& s) {
    load_blocks(a, a.values, a.networks - 1, first, s.X);
    load_blocks(a, grads, a.arrays, first, s.G);
    int output = 0;
    for (int network = 0; network < a.networks; ++network) {
        const int width = a.widths[network];
        const float* G = s.G + output * BLOCK;
        hidden_layer(a, network, s.X, s.H);
        outer(G, width, s.H, HIDDEN, g_weights + layout.weight_out + output * HIDDEN);
        product(weight_out_T + output * HIDDEN, HIDDEN, width, nullptr, false, G, s.g_H);
        for (int k = 0; k < HIDDEN * BLOCK; k += LANES) {
            select(Vec::load(s.H + k) > Vec(0.0f), Vec::load(s.g_H + k), Vec(0.0f)).store(s.g_H + k);
        }
        for (int f = 0; f < a.features_width; ++f) {
            outer(s.X + f * BLOCK, 1, s.g_H, HIDDEN,
                  g_weights + layout.weight_in + (f * a.networks + network) * HIDDEN);
        }
        add_row_sums(s.g_H, HIDDEN, g_weights + layout.bias_in + network * HIDDEN);
        product(weight_in_T + network * HIDDEN * a.features_width, a.features_width, HIDDEN, nullptr, network > 0, s.g_H,
                s.g_X);
        output += width;
    }
    add_row_sums(s.G, a.outputs, g_weights + layout.bias_out);
    const float* g_X = s.g_X;
    for (int i = 0; i < a.networks - 1; ++i) {
        store_block(g_X, grads[i], first, a.N, a.value_widths[i], g_features[i]);
        g_X += a.value_widths[i] * BLOCK;
    }
}

}  // namespace

void refine(const RefineArgs& a, float* const* out) {
    const size_t scratch_size = Scratch::size(a);
    Buffer<float> scratch(scratch_size * static_cast<size_t>(a.threads));
#pragma omp parallel for num_threads(a.threads) schedule(dynamic, 8) if (a.N > CHUNK)
    for (int64_t first = 0; first < a.N; first += BLOCK) {
        const Scratch s(a, scratch.data() + scratch_size * static_cast<size_t>(thread_index()));
        load_blocks(a, a.values, a.networks - 1, first, s.X);
        int output = 0;
        for (int network = 0; network < a.networks; ++network) {
            hidden_layer(a, network, s.X, s.H);
            product(a.weight_out + output * HIDDEN, a.widths[network], HIDDEN, a.bias_out + output, false, s.H,
                    s.G + output * BLOCK);
            output += a.widths[network];
        }
        const float* G = s.G;
        for (int i = 0; i < a.arrays; ++i) {
            store_block(G, a.values[i], first, a.N, a.value_widths[i], out[i]);
            G += a.value_widths[i] * BLOCK;
        }
    }
}

void refine_backward(const RefineArgs& a, const float* const* grads, const RefineGrads& out) {
    const WeightLayout layout(a);
    const size_t rows = static_cast<size_t>(a.networks) * HIDDEN, width = static_cast<size_t>(a.features_width);
    Buffer<float> weight_in_T(rows * width), weight_out_T(static_cast<size_t>(a.outputs) * HIDDEN);
    for (int network = 0, output = 0; network < a.networks; output += a.widths[network++]) {
        transpose(a.weight_in + network * HIDDEN * a.features_width, HIDDEN, a.features_width,
                  weight_in_T.data() + network * HIDDEN * a.features_width);
        transpose(a.weight_out + output * HIDDEN, a.widths[network], HIDDEN, weight_out_T.data() + output * HIDDEN);
    }
    const int64_t chunks = (a.N + CHUNK - 1) / CHUNK;
    const size_t scratch_size = Scratch::size(a), weights = static_cast<size_t>(layout.size);
    Buffer<float> scratch(scratch_size * static_cast<size_t>(a.threads)), partial(weights * static_cast<size_t>(chunks));
    partial.zero();
#pragma omp parallel for num_threads(a.threads) schedule(dynamic, 1) if (chunks > 1)
    for (int64_t chunk = 0; chunk < chunks; ++chunk) {
        const Scratch s(a, scratch.data() + scratch_size * static_cast<size_t>(thread_index()));
        for (int64_t first = chunk * CHUNK; first < (chunk + 1) * CHUNK && first < a.N; first += BLOCK) {
            backward_block(a, layout, weight_in_T.data(), weight_out_T.data(), first, grads, out.features,
                           partial.data() + weights * static_cast<size_t>(chunk), s);
        }
    }
    Buffer<float> total(weights);
    total.zero();
    for (size_t chunk = 0; chunk < static_cast<size_t>(chunks); ++chunk) {
        for (size_t k = 0; k < weights; ++k) total[k] += partial[chunk * weights + k];
    }
    transpose(total.data() + layout.weight_in, a.features_width, static_cast<int>(rows), out.weight_in);
    __builtin_memcpy(out.bias_in, total.data() + layout.bias_in, rows * sizeof(float));
    __builtin_memcpy(out.weight_out, total.data() + layout.weight_out,
                     static_cast<size_t>(a.outputs) * HIDDEN * sizeof(float));
    __builtin_memcpy(out.bias_out, total.data() + layout.bias_out, static_cast<size_t>(a.outputs) * sizeof(float));
}

}  // namespace GSB_ISA
}  // namespace gsb
