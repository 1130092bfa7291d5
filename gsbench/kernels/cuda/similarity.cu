// L1 and SSIM of two images with their gradient. Tiles of one channel with their border are in shared memory and are
// filtered along x, then along y. The gradient applies the same filter to the derivatives of SSIM by its filtered
// moments.
#include "../math/similarity.h"

#include <cmath>

#include "launch.h"

namespace gsb::cuda {
namespace {

constexpr int SIDE = 16, BORDERED = SIDE + 2 * SSIM_RADIUS, COLORS = 3;

struct Window {
    float weight[SSIM_WINDOW];
};

Window gaussian_window() {
    double weight[SSIM_WINDOW], total = 0.0;
    for (int i = 0; i < SSIM_WINDOW; ++i) {
        const double x = i - SSIM_RADIUS;
        total += weight[i] = std::exp(-x * x / (2.0 * SSIM_SIGMA * SSIM_SIGMA));
    }
    Window window;
    for (int i = 0; i < SSIM_WINDOW; ++i) window.weight[i] = static_cast<float>(weight[i] / total);
    return window;
}

// The position of this block's tile, and of this thread's pixel in the tile.
struct Place {
    int left, top, x, y, channel, thread;

    __device__ Place()
        : left(static_cast<int>(blockIdx.x) * SIDE), top(static_cast<int>(blockIdx.y) * SIDE),
          x(left + static_cast<int>(threadIdx.x)), y(top + static_cast<int>(threadIdx.y)),
          channel(static_cast<int>(blockIdx.z) % COLORS), thread(static_cast<int>(threadIdx.y * SIDE + threadIdx.x)) {}
};

__device__ float target_at(const SimilarityArgs& a, int64_t at) {
    return a.target_bytes ? over_255(static_cast<float>(a.target_bytes[at])) : a.target[at];
}

// Calls visit(row, column, x, y, whether inside the image) for each pixel of the tile and its border, each in one
// thread.
template <class Visit>
__device__ void each_bordered(const SimilarityArgs& a, const Place& place, Visit visit) {
    for (int i = place.thread; i < BORDERED * BORDERED; i += SIDE * SIDE) {
        const int row = i / BORDERED, column = i % BORDERED;
        const int x = place.left + column - SSIM_RADIUS, y = place.top + row - SSIM_RADIUS;
        visit(row, column, x, y, x >= 0 && x < a.width && y >= 0 && y < a.height);
    }
}

// Returns the sum over the block, in its first thread.
__device__ float block_sum(float x, int thread) {
    __shared__ float warps[SIDE * SIDE / WARP];
    const float sum = warp_sum(x);
    if (thread % WARP == 0) warps[thread / WARP] = sum;
    __syncthreads();
    float total = 0.0f;
    for (const float w : warps) total += w;
    return total;
}

__global__ void __launch_bounds__(SIDE * SIDE) compare_kernel(SimilarityArgs a, SimilarityLoss out, Window window) {
    constexpr int MOMENTS = 5;
    __shared__ float image[BORDERED][BORDERED], target[BORDERED][BORDERED];
    __shared__ float along_x[MOMENTS][BORDERED][SIDE];
    const Place place;
    begin_at_image(blockIdx.z / COLORS, a, out);
    each_bordered(a, place, [&](int row, int column, int x, int y, bool inside) {
        const int64_t at = (static_cast<int64_t>(y) * a.width + x) * COLORS + place.channel;
        image[row][column] = inside ? a.image[at] : 0.0f;
        target[row][column] = inside ? target_at(a, at) : 0.0f;
    });
    __syncthreads();
    for (int i = place.thread; i < BORDERED * SIDE; i += SIDE * SIDE) {
        const int row = i / SIDE, column = i % SIDE;
        float sums[MOMENTS] = {};
        for (int tap = 0; tap < SSIM_WINDOW; ++tap) {
            const float a = image[row][column + tap], b = target[row][column + tap], w = window.weight[tap];
            sums[0] += w * a;
            sums[1] += w * b;
            sums[2] += w * a * a;
            sums[3] += w * b * b;
            sums[4] += w * a * b;
        }
        for (int k = 0; k < MOMENTS; ++k) along_x[k][row][column] = sums[k];
    }
    __syncthreads();
    float m[MOMENTS] = {};
    for (int tap = 0; tap < SSIM_WINDOW; ++tap) {
        for (int k = 0; k < MOMENTS; ++k) m[k] += window.weight[tap] * along_x[k][threadIdx.y + tap][threadIdx.x];
    }
    const float scale = 1.0f / (static_cast<float>(COLORS) * static_cast<float>(a.width) * static_cast<float>(a.height));
    float loss = 0.0f;
    if (place.x < a.width && place.y < a.height) {
        const Similarity<float> s(m[0], m[1], m[2], m[3], m[4]);
        const int row = static_cast<int>(threadIdx.y) + SSIM_RADIUS, column = static_cast<int>(threadIdx.x) + SSIM_RADIUS;
        const float difference = fabsf(image[row][column] - target[row][column]);
        loss = ((1.0f - a.ssim_weight) * difference + a.ssim_weight * (1.0f - s.value)) * scale;
        if (out.gradient) {
            const int64_t pixels = static_cast<int64_t>(a.height) * a.width;
            float* at = out.scratch + place.channel * pixels + static_cast<int64_t>(place.y) * a.width + place.x;
            at[0] = s.g_mean;
            at[COLORS * pixels] = s.g_square;
            at[2 * COLORS * pixels] = s.g_product;
        }
    }
    const float total = block_sum(loss, place.thread);
    if (place.thread == 0) out.loss[(blockIdx.z * gridDim.y + blockIdx.y) * gridDim.x + blockIdx.x] = total;
}

__global__ void __launch_bounds__(SIDE * SIDE) gradient_kernel(SimilarityArgs a, SimilarityLoss out, Window window) {
    constexpr int DERIVATIVES = 3;
    __shared__ float planes[DERIVATIVES][BORDERED][BORDERED], along_x[DERIVATIVES][BORDERED][SIDE];
    const Place place;
    begin_at_image(blockIdx.z / COLORS, a, out);
    const int64_t pixels = static_cast<int64_t>(a.height) * a.width;
    each_bordered(a, place, [&](int row, int column, int x, int y, bool inside) {
        const int64_t at = place.channel * pixels + static_cast<int64_t>(y) * a.width + x;
        for (int k = 0; k < DERIVATIVES; ++k) {
            planes[k][row][column] = inside ? out.scratch[k * COLORS * pixels + at] : 0.0f;
        }
    });
    __syncthreads();
    for (int i = place.thread; i < BORDERED * SIDE; i += SIDE * SIDE) {
        const int row = i / SIDE, column = i % SIDE;
        float sums[DERIVATIVES] = {};
        for (int tap = 0; tap < SSIM_WINDOW; ++tap) {
            for (int k = 0; k < DERIVATIVES; ++k) sums[k] += window.weight[tap] * planes[k][row][column + tap];
        }
        for (int k = 0; k < DERIVATIVES; ++k) along_x[k][row][column] = sums[k];
    }
    __syncthreads();
    if (place.x >= a.width || place.y >= a.height) return;
    float g[DERIVATIVES] = {};
    for (int tap = 0; tap < SSIM_WINDOW; ++tap) {
        for (int k = 0; k < DERIVATIVES; ++k) g[k] += window.weight[tap] * along_x[k][threadIdx.y + tap][threadIdx.x];
    }
    const float scale = 1.0f / (static_cast<float>(COLORS) * static_cast<float>(a.width) * static_cast<float>(a.height));
    const int64_t at = (static_cast<int64_t>(place.y) * a.width + place.x) * COLORS + place.channel;
    const float x = a.image[at], y = target_at(a, at);
    const float sign = x > y ? 1.0f : x < y ? -1.0f : 0.0f;
    out.gradient[at] = scale * ((1.0f - a.ssim_weight) * sign - a.ssim_weight * (g[0] + 2.0f * x * g[1] + y * g[2]));
}

dim3 tiles(int images, int height, int width) {
    const auto along = [](int pixels) { return static_cast<unsigned>((pixels + SIDE - 1) / SIDE); };
    return {along(width), along(height), static_cast<unsigned>(COLORS * images)};
}

}  // namespace

int similarity_parts(int height, int width) {
    const dim3 grid = tiles(1, height, width);
    return static_cast<int>(grid.x * grid.y * grid.z);
}

void l1_ssim(const SimilarityArgs& a, const SimilarityLoss& out, Stream stream) {
    const Window window = gaussian_window();
    const dim3 grid = tiles(a.C, a.height, a.width), block(SIDE, SIDE);
    launch(compare_kernel, grid, block, stream, a, out, window);
    if (out.gradient) launch(gradient_kernel, grid, block, stream, a, out, window);
}

}  // namespace gsb::cuda
