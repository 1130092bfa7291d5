// AGR (7DGS, section 4.3): a few perceptrons of two layers move every Gaussian. Weights lie in shared memory and hidden
// units in registers, so that nothing but the Gaussians' values is read or written; backward computes the hidden units
// again, 32 Gaussians at a time.
#include "launch.h"

namespace gsb::cuda {
namespace {

constexpr int HIDDEN = 64;

// One network's weights as its inner loops read them: everything of a hidden unit side by side.
struct Network {
    float in[HIDDEN][MAX_FEATURES];  // the last column is the bias
    float out[HIDDEN][MAX_WIDTH];

    // By all threads of the block; the caller has them wait for it.
    __device__ void load(const RefineArgs& a, int network, int first_output) {
        const int width = a.widths[network];
        for (int k = static_cast<int>(threadIdx.x); k < HIDDEN * MAX_FEATURES; k += static_cast<int>(blockDim.x)) {
            const int unit = network * HIDDEN + k / MAX_FEATURES, f = k % MAX_FEATURES;
            in[k / MAX_FEATURES][f] = f < a.features_width     ? a.weight_in[unit * a.features_width + f]
                                      : f == MAX_FEATURES - 1 ? a.bias_in[unit]
                                                               : 0.0f;
        }
        for (int k = static_cast<int>(threadIdx.x); k < HIDDEN * MAX_WIDTH; k += static_cast<int>(blockDim.x)) {
            const int unit = k / MAX_WIDTH, c = k % MAX_WIDTH;
            out[unit][c] = c < width ? a.weight_out[(first_output + c) * HIDDEN + unit] : 0.0f;
        }
    }

    __device__ float hidden(int unit, const float (&x)[MAX_FEATURES]) const {
        float sum = 0.0f;
        GSB_UNROLL for (int f = 0; f < MAX_FEATURES; ++f) sum += in[unit][f] * x[f];
        return max(sum, 0.0f);
    }
};

// A Gaussian's features, and a one for the bias.
__device__ void load_features(const RefineArgs& a, int64_t i, float (&x)[MAX_FEATURES]) {
    GSB_UNROLL for (int f = 0; f < MAX_FEATURES - 1; ++f) {
        x[f] = i < a.N && f < a.features_width ? a.features[f].from[i * a.features[f].stride] : 0.0f;
    }
    x[MAX_FEATURES - 1] = 1.0f;
}

__device__ int first_output_of(const RefineArgs& a, int network) {
    int first = 0;
    for (int k = 0; k < network; ++k) first += a.widths[k];
    return first;
}

constexpr int AT_ONCE = 4;  // Gaussians of a thread: a weight that is read from shared memory serves all of them
constexpr int MOVERS = 128;  // threads of a block

// A row of blocks a network, the last and widest first.
__global__ void __launch_bounds__(MOVERS) refine_kernel(const __grid_constant__ RefineArgs a) {
    __shared__ Network net;
    const int network = a.networks - 1 - static_cast<int>(blockIdx.y);
    const int first = first_output_of(a, network), width = a.widths[network];
    net.load(a, network, first);
    __syncthreads();
    const int64_t begin = static_cast<int64_t>(blockIdx.x) * MOVERS * AT_ONCE + threadIdx.x;
    float x[AT_ONCE][MAX_FEATURES], sums[AT_ONCE][MAX_WIDTH];
    GSB_UNROLL for (int n = 0; n < AT_ONCE; ++n) {
        load_features(a, begin + n * MOVERS, x[n]);
        GSB_UNROLL for (int c = 0; c < MAX_WIDTH; ++c) sums[n][c] = c < width ? a.bias_out[first + c] : 0.0f;
    }
    for (int unit = 0; unit < HIDDEN; ++unit) {
        float h[AT_ONCE];
        GSB_UNROLL for (int n = 0; n < AT_ONCE; ++n) h[n] = net.hidden(unit, x[n]);
        GSB_UNROLL for (int c = 0; c < MAX_WIDTH; ++c) {
            if (c / 4 * 4 >= width) continue;
            GSB_UNROLL for (int n = 0; n < AT_ONCE; ++n) sums[n][c] += h[n] * net.out[unit][c];
        }
    }
    GSB_UNROLL for (int c = 0; c < MAX_WIDTH; ++c) {
        if (c >= width) continue;
        const Column column = a.moved[network][c];
        GSB_UNROLL for (int n = 0; n < AT_ONCE; ++n) {
            const int64_t i = begin + n * MOVERS, at = i * column.stride;
            if (i < a.N) column.to[at] = column.from[at] + sums[n][c];
        }
    }
}

constexpr int BATCH = 32;             // Gaussians at a time, one a lane of every warp
constexpr int PARTS = 4;              // warps, each with a part of the hidden units
constexpr int UNITS = HIDDEN / PARTS;
constexpr int HALVES = BATCH * PARTS / HIDDEN;  // threads that share a hidden unit when weights' gradients are summed
constexpr int COLUMNS = MAX_WIDTH / HALVES, ROWS = MAX_FEATURES / HALVES;
static_assert(HALVES == 2);

struct BackwardBatch {
    float x[BATCH][MAX_FEATURES], g[BATCH][MAX_WIDTH];
    float h[HIDDEN][BATCH + 1], g_h[HIDDEN][BATCH + 1];  // one more, so that lanes meet in no bank
    float g_x[PARTS][BATCH][MAX_FEATURES];
};

// A row of blocks a network; each block sums the weights' gradients over the batches it takes, and adds them at the end.
__global__ void __launch_bounds__(BATCH * PARTS)
    refine_backward_kernel(const __grid_constant__ RefineArgs a, RefineGrads out) {
    __shared__ Network net;
    __shared__ BackwardBatch batch;
    const int network = static_cast<int>(blockIdx.y), first = first_output_of(a, network), width = a.widths[network];
    const int thread = static_cast<int>(threadIdx.x), lane = thread % BATCH, part = thread / BATCH;
    const int my_unit = thread % HIDDEN, half = thread / HIDDEN;
    float g_out[COLUMNS] = {}, g_in[ROWS] = {}, g_bias = 0.0f;
    net.load(a, network, first);
    for (int64_t begin = static_cast<int64_t>(blockIdx.x) * BATCH; begin < a.N; begin += int64_t{gridDim.x} * BATCH) {
        __syncthreads();  // the weights are there, and the last batch is done with
        const int64_t i = begin + lane;
        float x[MAX_FEATURES], g[MAX_WIDTH], g_x[MAX_FEATURES] = {};
        load_features(a, i, x);
        GSB_UNROLL for (int c = 0; c < MAX_WIDTH; ++c) {
            const Column& column = a.moved[network][c];
            g[c] = i < a.N && c < width ? column.from[i * column.stride] : 0.0f;
        }
        if (part == 0) {
            GSB_UNROLL for (int f = 0; f < MAX_FEATURES; ++f) batch.x[lane][f] = x[f];
            GSB_UNROLL for (int c = 0; c < MAX_WIDTH; ++c) batch.g[lane][c] = g[c];
        }
        for (int unit = part * UNITS; unit < (part + 1) * UNITS; ++unit) {
            const float h = net.hidden(unit, x);
            float g_h = 0.0f;
            GSB_UNROLL for (int c = 0; c < MAX_WIDTH; ++c) {
                if (c / 4 * 4 < width) g_h += g[c] * net.out[unit][c];
            }
            g_h = h > 0.0f ? g_h : 0.0f;
            GSB_UNROLL for (int f = 0; f < MAX_FEATURES; ++f) g_x[f] += g_h * net.in[unit][f];
            batch.h[unit][lane] = h;
            batch.g_h[unit][lane] = g_h;
        }
        GSB_UNROLL for (int f = 0; f < MAX_FEATURES; ++f) batch.g_x[part][lane][f] = g_x[f];
        __syncthreads();
        for (int n = 0; n < BATCH; ++n) {
            const float h = batch.h[my_unit][n], g_h = batch.g_h[my_unit][n];
            GSB_UNROLL for (int c = 0; c < COLUMNS; ++c) {
                if (half * COLUMNS + c < width) g_out[c] += h * batch.g[n][half * COLUMNS + c];
            }
            GSB_UNROLL for (int f = 0; f < ROWS; ++f) g_in[f] += g_h * batch.x[n][half * ROWS + f];
            if (thread < width) g_bias += batch.g[n][thread];
        }
        for (int k = thread; k < BATCH * a.features_width; k += BATCH * PARTS) {
            const int n = k / a.features_width, f = k % a.features_width;
            float sum = 0.0f;
            for (int p = 0; p < PARTS; ++p) sum += batch.g_x[p][n][f];
            if (begin + n < a.N) out.features[(network * a.N + begin + n) * a.features_width + f] = sum;
        }
    }
    const int unit = network * HIDDEN + my_unit;
    GSB_UNROLL for (int c = 0; c < COLUMNS; ++c) {
        const int column = half * COLUMNS + c;
        if (column < width) atomicAdd(out.weight_out + (first + column) * HIDDEN + my_unit, g_out[c]);
    }
    GSB_UNROLL for (int f = 0; f < ROWS; ++f) {
        const int row = half * ROWS + f;
        if (row < a.features_width) atomicAdd(out.weight_in + unit * a.features_width + row, g_in[f]);
        if (row == MAX_FEATURES - 1) atomicAdd(out.bias_in + unit, g_in[f]);
    }
    if (thread < width) atomicAdd(out.bias_out + first + thread, g_bias);
}

// A feature moves through every network, and itself: the gradient of what it was moved to is there already.
__global__ void feature_kernel(const __grid_constant__ RefineArgs a, const float* by_network) {
    const int64_t i = global_thread(), step = a.N * a.features_width;
    if (i >= a.N) return;
    GSB_UNROLL for (int f = 0; f < MAX_FEATURES - 1; ++f) {
        if (f >= a.features_width) continue;
        float sum = 0.0f;
        GSB_UNROLL for (int network = 0; network < MAX_NETWORKS; ++network) {
            if (network < a.networks) sum += by_network[network * step + i * a.features_width + f];
        }
        a.features[f].to[i * a.features[f].stride] += sum;
    }
}

}  // namespace

void refine(const RefineArgs& a, Stream stream) {
    if (a.N == 0) return;
    const auto blocks = static_cast<unsigned>((a.N + MOVERS * AT_ONCE - 1) / (MOVERS * AT_ONCE));
    launch(refine_kernel, dim3(blocks, static_cast<unsigned>(a.networks)), MOVERS, stream, a);
}

void refine_backward(const RefineArgs& a, const RefineGrads& out, Stream stream) {
    if (a.N == 0) return;
    // Each block adds its sums by atomics once: few blocks, but enough to fill the largest GPUs.
    constexpr unsigned MOST_BLOCKS = 512;
    const auto batches = static_cast<unsigned>((a.N + BATCH - 1) / BATCH);
    const dim3 grid(batches < MOST_BLOCKS ? batches : MOST_BLOCKS, static_cast<unsigned>(a.networks));
    launch(refine_backward_kernel, grid, BATCH * PARTS, stream, a, out);
    launch(feature_kernel, blocks_for(a.N), THREADS, stream, a, out.features);
}

}  // namespace gsb::cuda
