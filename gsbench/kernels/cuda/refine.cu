// AGR, the neural refinement of 7DGS (section 4.3): a few two-layer MLPs change the parameters of every Gaussian, for
// the times of one or several views. Weights are in shared memory and hidden units in registers, so that only parameters
// of Gaussians are read and written. The backward pass computes the hidden units again, 32 Gaussians at a time.
#include "../math/awake.h"

#include <algorithm>
#include <numeric>
#include <stdexcept>
#include <string>

#include "launch.h"

namespace gsb::cuda {
namespace {

constexpr int INPUTS = MAX_FEATURES + 1;  // a one comes last, whose weight is the bias

// A column of an array [N, stride]: the address to read, and the address for the result.
struct Column {
    const float* from;
    float* to;
    int64_t stride;
};

// All MLPs, with the columns of the arrays that they read and change.
struct Networks {
    int64_t N, rows, V;  // Gaussians that are moved, all Gaussians, views
    int features, encoded, count, widths[MAX_NETWORKS];
    Column read[MAX_FEATURES];              // what the networks read
    Column moved[MAX_NETWORKS][MAX_WIDTH];  // what each network moves; backward: the gradient of what it was moved to
    const float *weight_in, *bias_in, *weight_out, *bias_out, *units, *gamma, *intervals, *time;  // as in RefineArgs

    __device__ bool moves(int64_t i, int64_t view) const { return i < N && is_awake(intervals, time + view, i); }
    // Returns the place of a column's number of Gaussian i as a view sees it.
    __device__ int64_t at(const Column& column, int64_t i, int64_t view) const {
        return (view * rows + i) * column.stride;
    }
};

// The gradients of the features (the inputs of the MLPs), by column.
struct FeatureGrads {
    Column column[MAX_FEATURES];
};

// The weights of one MLP in the order of its inner loops: all weights of a hidden unit are adjacent. They are those of
// parameters in their own units, see RefineArgs.
struct Network {
    float in[HIDDEN][INPUTS];  // the last column is the bias at the time of a view
    float out[HIDDEN][MAX_WIDTH];

    // Called by all threads of the block; the caller synchronises them afterwards.
    __device__ void load(const Networks& a, int network, int first_output) {
        const int width = a.widths[network];
        for (int k = static_cast<int>(threadIdx.x); k < HIDDEN * INPUTS; k += static_cast<int>(blockDim.x)) {
            const int unit = network * HIDDEN + k / INPUTS, f = k % INPUTS;
            if (f < MAX_FEATURES) in[k / INPUTS][f] = f < a.features ? weights_in(a, unit)[f] / a.units[f] : 0.0f;
        }
        for (int k = static_cast<int>(threadIdx.x); k < HIDDEN * MAX_WIDTH; k += static_cast<int>(blockDim.x)) {
            const int unit = k / MAX_WIDTH, c = k % MAX_WIDTH;
            const int output = first_output + c;
            out[unit][c] = c < width ? a.weight_out[output * HIDDEN + unit] * a.units[output] : 0.0f;
        }
    }

    // Computes the biases at the time of a view, also for all threads of the block.
    __device__ void see(const Networks& a, int network, int64_t view) {
        for (int k = static_cast<int>(threadIdx.x); k < HIDDEN; k += static_cast<int>(blockDim.x)) {
            const int unit = network * HIDDEN + k;
            const float *weights = weights_in(a, unit) + a.features, *gamma = a.gamma + view * a.encoded;
            float bias = a.bias_in[unit];
            for (int g = 0; g < a.encoded; ++g) bias += weights[g] * gamma[g];
            in[k][MAX_FEATURES] = bias;
        }
    }

    // Returns the first layer's weights of a hidden unit: those of the features, then those of the encoded time.
    __device__ static const float* weights_in(const Networks& a, int unit) {
        return a.weight_in + unit * (a.features + a.encoded);
    }

    __device__ float hidden(int unit, const float (&x)[INPUTS]) const {
        float sum = 0.0f;
        GSB_UNROLL for (int f = 0; f < INPUTS; ++f) sum += in[unit][f] * x[f];
        return max(sum, 0.0f);
    }
};

// Loads a Gaussian's features, followed by a one for the bias.
__device__ void load_features(const Networks& a, int64_t i, float (&x)[INPUTS]) {
    GSB_UNROLL for (int f = 0; f < MAX_FEATURES; ++f) {
        x[f] = i < a.N && f < a.features ? a.read[f].from[i * a.read[f].stride] : 0.0f;
    }
    x[MAX_FEATURES] = 1.0f;
}

__device__ int first_output_of(const Networks& a, int network) {
    int first = 0;
    for (int k = 0; k < network; ++k) first += a.widths[k];
    return first;
}

constexpr int AT_ONCE = 4;  // Gaussians of a thread: a weight that is read from shared memory serves all of them
constexpr int MOVERS = 128;  // threads of a block

// The grid has one row of blocks per MLP, the last and widest MLP first, and a layer of blocks per view: a loop over the
// views would need more than all registers.
__global__ void __launch_bounds__(MOVERS) refine_kernel(const __grid_constant__ Networks a) {
    __shared__ Network net;
    const int network = a.count - 1 - static_cast<int>(blockIdx.y);
    const int first = first_output_of(a, network), width = a.widths[network];
    const int64_t view = blockIdx.z;
    net.load(a, network, first);
    net.see(a, network, view);
    __syncthreads();
    const int64_t begin = static_cast<int64_t>(blockIdx.x) * MOVERS * AT_ONCE + threadIdx.x;
    float x[AT_ONCE][INPUTS], sums[AT_ONCE][MAX_WIDTH];
    bool moves[AT_ONCE], any = false;
    GSB_UNROLL for (int n = 0; n < AT_ONCE; ++n) {
        moves[n] = a.moves(begin + n * MOVERS, view);
        any |= moves[n];
        load_features(a, begin + n * MOVERS, x[n]);
        GSB_UNROLL for (int c = 0; c < MAX_WIDTH; ++c) {
            sums[n][c] = c < width ? a.bias_out[first + c] * a.units[first + c] : 0.0f;
        }
    }
    for (int unit = 0; unit < (any ? HIDDEN : 0); ++unit) {
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
            const int64_t i = begin + n * MOVERS;
            if (i >= a.N) continue;
            const float from = column.from[i * column.stride];
            column.to[a.at(column, i, view)] = moves[n] ? from + sums[n][c] : from;
        }
    }
}

constexpr int BATCH = 32;             // Gaussians at a time, one a lane of every warp
constexpr int PARTS = 4;              // warps, each with a part of the hidden units
constexpr int UNITS = HIDDEN / PARTS;
constexpr int HALVES = BATCH * PARTS / HIDDEN;  // threads that share a hidden unit when weights' gradients are summed
constexpr int COLUMNS = MAX_WIDTH / HALVES, ROWS = INPUTS / HALVES;
static_assert(HALVES == 2);

struct BackwardBatch {
    float x[BATCH][INPUTS], g[BATCH][MAX_WIDTH];
    float h[HIDDEN][BATCH + 1], g_h[HIDDEN][BATCH + 1];  // one more, so that lanes meet in no bank
    float g_x[PARTS][BATCH][INPUTS];
};

// The grid has one row of blocks per MLP. Each block sums the gradients of the weights over all views of its batches of
// Gaussians, and adds them to the result at the end; those of the first layer's biases at the end of each view.
__global__ void __launch_bounds__(BATCH * PARTS)
    refine_backward_kernel(const __grid_constant__ Networks a, RefineGrads out) {
    __shared__ Network net;
    __shared__ BackwardBatch batch;
    const int network = static_cast<int>(blockIdx.y), first = first_output_of(a, network), width = a.widths[network];
    const int thread = static_cast<int>(threadIdx.x), lane = thread % BATCH, part = thread / BATCH;
    const int my_unit = thread % HIDDEN, half = thread / HIDDEN;
    const int unit_of_all = network * HIDDEN + my_unit;
    float g_out[COLUMNS] = {}, g_in[ROWS] = {}, g_bias = 0.0f;
    net.load(a, network, first);
    for (int64_t view = 0; view < a.V; ++view) {
        __syncthreads();  // the last view is done with the biases
        net.see(a, network, view);
        for (int64_t begin = int64_t{blockIdx.x} * BATCH; begin < a.N; begin += int64_t{gridDim.x} * BATCH) {
            __syncthreads();  // the weights are there, and the last batch is done with
            const int64_t i = begin + lane;
            const bool moves = a.moves(i, view);
            float x[INPUTS], g[MAX_WIDTH], g_x[INPUTS] = {};
            load_features(a, i, x);
            GSB_UNROLL for (int c = 0; c < MAX_WIDTH; ++c) {
                const Column& column = a.moved[network][c];
                g[c] = moves && c < width ? column.from[a.at(column, i, view)] : 0.0f;
            }
            if (part == 0) {
                GSB_UNROLL for (int f = 0; f < INPUTS; ++f) batch.x[lane][f] = x[f];
                GSB_UNROLL for (int c = 0; c < MAX_WIDTH; ++c) batch.g[lane][c] = g[c];
            }
            for (int unit = part * UNITS; unit < (part + 1) * UNITS; ++unit) {
                const float h = net.hidden(unit, x);
                float g_h = 0.0f;
                GSB_UNROLL for (int c = 0; c < MAX_WIDTH; ++c) {
                    if (c / 4 * 4 < width) g_h += g[c] * net.out[unit][c];
                }
                g_h = h > 0.0f ? g_h : 0.0f;
                GSB_UNROLL for (int f = 0; f < INPUTS; ++f) g_x[f] += g_h * net.in[unit][f];
                batch.h[unit][lane] = h;
                batch.g_h[unit][lane] = g_h;
            }
            GSB_UNROLL for (int f = 0; f < INPUTS; ++f) batch.g_x[part][lane][f] = g_x[f];
            __syncthreads();
            for (int n = 0; n < BATCH; ++n) {
                const float h = batch.h[my_unit][n], g_h = batch.g_h[my_unit][n];
                GSB_UNROLL for (int c = 0; c < COLUMNS; ++c) {
                    if (half * COLUMNS + c < width) g_out[c] += h * batch.g[n][half * COLUMNS + c];
                }
                GSB_UNROLL for (int f = 0; f < ROWS; ++f) g_in[f] += g_h * batch.x[n][half * ROWS + f];
                if (thread < width) g_bias += batch.g[n][thread];
            }
            for (int k = thread; k < BATCH * a.features; k += BATCH * PARTS) {
                const int n = k / a.features, f = k % a.features;
                float sum = 0.0f;
                for (int p = 0; p < PARTS; ++p) sum += batch.g_x[p][n][f];
                if (begin + n < a.N) out.scratch[((network * a.V + view) * a.N + begin + n) * a.features + f] = sum;
            }
        }
        if (half == HALVES - 1) {  // which has the row of biases
            atomicAdd(out.biases + view * a.count * HIDDEN + unit_of_all, g_in[ROWS - 1]);
            g_in[ROWS - 1] = 0.0f;
        }
    }
    GSB_UNROLL for (int c = 0; c < COLUMNS; ++c) {
        const int column = half * COLUMNS + c;
        if (column >= width) continue;
        atomicAdd(out.weight_out + (first + column) * HIDDEN + my_unit, g_out[c] * a.units[first + column]);
    }
    GSB_UNROLL for (int f = 0; f < ROWS; ++f) {
        const int row = half * ROWS + f;
        if (row >= a.features) continue;
        atomicAdd(out.weight_in + unit_of_all * (a.features + a.encoded) + row, g_in[f] / a.units[row]);
    }
    if (thread < width) atomicAdd(out.bias_out + first + thread, g_bias * a.units[first + thread]);
}

// The gradients of the first layers' biases and of their weights of the encoded time, from those of the biases at the
// time of each view; a thread for each.
__global__ void time_kernel(const __grid_constant__ Networks a, RefineGrads out) {
    const int units = a.count * HIDDEN, numbers = a.encoded + 1;
    const int thread = static_cast<int>(global_thread()), unit = thread / numbers, g = thread % numbers;
    if (unit >= units) return;
    float sum = 0.0f;
    for (int64_t view = 0; view < a.V; ++view) {
        const float bias = out.biases[view * units + unit];
        sum += g < a.encoded ? bias * a.gamma[view * a.encoded + g] : bias;
    }
    float* weight = out.weight_in + unit * (a.features + a.encoded) + a.features + g;
    *(g < a.encoded ? weight : out.bias_in + unit) = sum;
}

// The gradient of a feature, for each view its own plus those through all MLPs.
__global__ void feature_kernel(const __grid_constant__ Networks a, const __grid_constant__ FeatureGrads grads,
                               const float* by_network) {
    const int64_t i = global_thread(), step = a.N * a.features;
    if (i >= a.N) return;
    GSB_UNROLL for (int f = 0; f < MAX_FEATURES; ++f) {
        if (f >= a.features) continue;
        const Column column = grads.column[f];
        float of_views = 0.0f;
        for (int64_t view = 0; view < a.V; ++view) {
            float sum = 0.0f;
            GSB_UNROLL for (int network = 0; network < MAX_NETWORKS; ++network) {
                if (network < a.count) sum += by_network[(network * a.V + view) * step + i * a.features + f];
            }
            of_views += column.from[a.at(column, i, view)] + sum;
        }
        column.to[i * column.stride] = of_views;
    }
}

// Parts of arrays that are copied to each view, or whose views are added up; one row of blocks each.
struct Parts {
    int64_t V;
    const float* from[MAX_VALUES];
    float* to[MAX_VALUES];
    int64_t size[MAX_VALUES], step[MAX_VALUES];  // of the part; from one view to the next

    void add(int i, const float* from_first, float* to_first, int64_t rows, int64_t first_row, int64_t width) {
        from[i] = from_first + first_row * width, to[i] = to_first + first_row * width;
        size[i] = (rows - first_row) * width, step[i] = rows * width;
    }
};

__global__ void copy_kernel(const __grid_constant__ Parts all) {
    const int64_t k = global_thread();
    const unsigned i = blockIdx.y;
    if (k >= all.size[i]) return;
    for (int64_t view = 0; view < all.V; ++view) all.to[i][view * all.step[i] + k] = all.from[i][k];
}

__global__ void sum_kernel(const __grid_constant__ Parts all) {
    const int64_t k = global_thread();
    const unsigned i = blockIdx.y;
    if (k >= all.size[i]) return;
    float sum = 0.0f;
    for (int64_t view = 0; view < all.V; ++view) sum += all.from[i][view * all.step[i] + k];
    all.to[i][k] = sum;
}

void launch_parts(void (*kernel)(Parts), const Parts& all, int count, Stream stream) {
    const int64_t most = *std::max_element(all.size, all.size + count);
    if (most > 0) launch(kernel, dim3(blocks_for(most), static_cast<unsigned>(count)), THREADS, stream, all);
}

// Returns column `c` of the arrays [N, value_widths], counted through all arrays in order. `to` may be null.
Column column_of(const RefineArgs& a, const float* const* from, float* const* to, int c) {
    int array = 0;
    while (c >= a.value_widths[array]) c -= a.value_widths[array++];
    return {from[array] + c, to ? to[array] + c : nullptr, a.value_widths[array]};
}

// Returns the MLPs with the columns that they change, from arrays `from` to arrays `to`. Each MLP changes the columns
// after those of the MLP before it.
Networks networks_of(const RefineArgs& a, const float* const* from, float* const* to) {
    Networks all{a.refined,   a.N,       a.V,          a.features, a.encoded, a.networks, {},          {},    {},
                 a.weight_in, a.bias_in, a.weight_out, a.bias_out, a.units,   a.gamma,    a.intervals, a.time};
    const int widest = *std::max_element(a.widths, a.widths + MAX_NETWORKS);
    if (a.features > MAX_FEATURES || widest > MAX_WIDTH) {
        throw std::invalid_argument("refine: expected on a GPU at most " + std::to_string(MAX_FEATURES) +
                                    " features and networks of at most " + std::to_string(MAX_WIDTH) +
                                    " outputs, got " + std::to_string(a.features) + " and " + std::to_string(widest));
    }
    const int columns = std::accumulate(a.value_widths, a.value_widths + MAX_VALUES, 0);
    if (std::accumulate(a.widths, a.widths + MAX_NETWORKS, 0) != columns) {
        throw std::invalid_argument("refine: expected networks that move all " + std::to_string(columns) +
                                    " columns of the values, got other widths");
    }
    for (int f = 0; f < a.features; ++f) all.read[f] = column_of(a, a.values, nullptr, f);
    for (int network = 0, first = 0; network < a.networks; first += a.widths[network++]) {
        all.widths[network] = a.widths[network];
        for (int c = 0; c < a.widths[network]; ++c) all.moved[network][c] = column_of(a, from, to, first + c);
    }
    return all;
}

}  // namespace

void refine(const RefineArgs& a, const Refined& out, Stream stream) {
    const Networks networks = networks_of(a, a.values, out.values);
    Parts rest{a.V, {}, {}, {}, {}};  // what AGR does not change
    for (int i = 0; i < a.arrays; ++i) rest.add(i, a.values[i], out.values[i], a.N, a.refined, a.value_widths[i]);
    launch_parts(copy_kernel, rest, a.arrays, stream);
    if (a.refined == 0) return;
    const auto blocks = static_cast<unsigned>((a.refined + MOVERS * AT_ONCE - 1) / (MOVERS * AT_ONCE));
    const dim3 grid(blocks, static_cast<unsigned>(a.networks), static_cast<unsigned>(a.V));
    launch(refine_kernel, grid, MOVERS, stream, networks);
}

void refine_backward(const RefineArgs& a, const RefinedGrads& grads, const RefineGrads& out, Stream stream) {
    const Networks networks = networks_of(a, grads.values, nullptr);
    Parts rest{a.V, {}, {}, {}, {}};  // features that AGR does not change, and all else, which it adds to
    for (int i = 0; i < a.arrays; ++i) {
        const int64_t first = i < a.networks - 1 ? a.refined : 0;
        if (out.values[i]) rest.add(i, grads.values[i], out.values[i], a.N, first, a.value_widths[i]);
    }
    launch_parts(sum_kernel, rest, a.arrays, stream);
    if (a.refined == 0) return;
    FeatureGrads features{};
    for (int f = 0; f < a.features; ++f) features.column[f] = column_of(a, grads.values, out.values, f);
    // Each block adds its sums once by atomics, so there are few blocks, but enough for the largest GPUs.
    constexpr unsigned MOST_BLOCKS = 512;
    const auto batches = static_cast<unsigned>((a.refined + BATCH - 1) / BATCH);
    const dim3 grid(batches < MOST_BLOCKS ? batches : MOST_BLOCKS, static_cast<unsigned>(a.networks));
    launch(refine_backward_kernel, grid, BATCH * PARTS, stream, networks, out);
    const auto numbers = static_cast<int64_t>(a.networks) * HIDDEN * (a.encoded + 1);
    launch(time_kernel, blocks_for(numbers), THREADS, stream, networks, out);
    launch(feature_kernel, blocks_for(a.refined), THREADS, stream, networks, features, out.scratch);
}

}  // namespace gsb::cuda
