// Projecting Gaussians to splats, one Gaussian before one camera a thread; its derivative; and a look at the values.
#include <cfloat>

#include "launch.h"

namespace gsb::cuda {
namespace {

__device__ Camera camera_of(const Cameras& a, int64_t c) {
    const float *view = a.viewmats + c * 16, *K = a.Ks + c * 9;
    Camera camera;
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) camera.rotation[i][j] = view[i * 4 + j];
        camera.translation[i] = view[i * 4 + 3];
    }
    camera.fx = K[0], camera.cx = K[2], camera.fy = K[4], camera.cy = K[5];
    camera.width = static_cast<float>(a.width), camera.height = static_cast<float>(a.height);
    camera.near = a.near, camera.far = a.far, camera.eps2d = a.eps2d, camera.antialias = a.antialias;
    return camera;
}

__device__ Vec3<float> vec3(const float* p) { return {p[0], p[1], p[2]}; }

__device__ void store(const Vec3<float>& v, float* p) { p[0] = v.x, p[1] = v.y, p[2] = v.z; }

__device__ Projection<float> projection_of(const Gaussians& g, const Camera& camera, int64_t i) {
    const float* F = g.factors + i * 9;
    const Vec3<float> factor[3] = {vec3(F), vec3(F + 3), vec3(F + 6)};
    return {camera, vec3(g.means + i * 3), factor, g.opacities[i]};
}

__global__ void project_kernel(Gaussians gaussians, Cameras cameras, Splats out) {
    const int64_t i = global_thread();
    if (i >= gaussians.N) return;
    for (int64_t c = blockIdx.y; c < cameras.C; c += gridDim.y) {
        const Camera camera = camera_of(cameras, c);
        const Splat<float> s = projection_of(gaussians, camera, i).splat();
        const int64_t at = c * gaussians.N + i;
        reinterpret_cast<float2*>(out.means2d)[at] = {s.x, s.y};
        reinterpret_cast<float4*>(out.roots)[at] = {s.p, s.q, s.r, s.opacity};
        reinterpret_cast<float2*>(out.half_sizes)[at] = {s.half_x, s.half_y};
        out.depths[at] = s.depth;
    }
}

__device__ Splat<float> splat_grad(const SplatGrads& g, int64_t at) {
    Splat<float> out{};
    if (g.means2d) out.x = g.means2d[at * 2], out.y = g.means2d[at * 2 + 1];
    if (g.roots) {
        const float4 root = reinterpret_cast<const float4*>(g.roots)[at];
        out.p = root.x, out.q = root.y, out.r = root.z, out.opacity = root.w;
    }
    if (g.depths) out.depth = g.depths[at];
    return out;
}

// Adds a warp's sums to the gradient of one camera; `grad` is zero in lanes that have none.
__device__ void add_camera_grad(const GaussianGrad<float>& grad, float* viewmat) {
    for (int row = 0; row < 3; ++row) {
        const Vec3<float>& r = grad.rotation[row];
        const Vec3<float>& t = grad.translation;
        const float sums[4] = {warp_sum(r.x), warp_sum(r.y), warp_sum(r.z),
                               warp_sum(row == 0 ? t.x : row == 1 ? t.y : t.z)};
        if (threadIdx.x % WARP == 0) {
            for (int column = 0; column < 4; ++column) atomicAdd(viewmat + row * 4 + column, sums[column]);
        }
    }
}

__global__ void project_backward_kernel(Gaussians gaussians, Cameras cameras, SplatGrads grads, GaussianGrads out) {
    const int64_t i = global_thread();
    const bool exists = i < gaussians.N;
    GaussianGrad<float> sum{};
    for (int64_t c = 0; c < cameras.C; ++c) {
        GaussianGrad<float> grad{};
        if (exists) {
            const Camera camera = camera_of(cameras, c);
            Projection<float> projection = projection_of(gaussians, camera, i);
            const Splat<float> splat = projection.splat();
            if (splat.half_x > 0.0f) grad = projection.vjp(splat, splat_grad(grads, c * gaussians.N + i));
        }
        sum.mean += grad.mean;
        for (int row = 0; row < 3; ++row) sum.factor[row] += grad.factor[row];
        sum.opacity += grad.opacity;
        if (out.viewmats) add_camera_grad(grad, out.viewmats + c * 16);
    }
    if (!exists) return;
    store(sum.mean, out.means + i * 3);
    for (int row = 0; row < 3; ++row) store(sum.factor[row], out.factors + i * 9 + row * 3);
    out.opacities[i] = sum.opacity;
}

struct Range {
    const float* values;
    int64_t count, stride;
    float low, high;
    int64_t bit;
};

constexpr int RANGES = 9;

struct Ranges {
    Range range[RANGES];
};

__global__ void flag_kernel(Ranges ranges, int64_t* flags) {
    const int64_t step = static_cast<int64_t>(gridDim.x) * blockDim.x;
    for (const Range& r : ranges.range) {
        bool good = true;
        for (int64_t i = global_thread(); i < r.count; i += step) {
            const float x = r.values[i * r.stride];
            good &= x >= r.low && x <= r.high;  // false for NaN
        }
        if (!good) atomicOr(reinterpret_cast<unsigned long long*>(flags), 1ull << r.bit);
    }
}

}  // namespace

void project(const Gaussians& gaussians, const Cameras& cameras, const Splats& out, Stream stream) {
    if (gaussians.N == 0) return;
    constexpr int64_t MOST_ROWS = 65535;  // of blocks; further cameras are taken in turns
    const dim3 grid(blocks_for(gaussians.N), static_cast<unsigned>(cameras.C < MOST_ROWS ? cameras.C : MOST_ROWS));
    launch(project_kernel, grid, THREADS, stream, gaussians, cameras, out);
}

void project_backward(const Gaussians& gaussians, const Cameras& cameras, const SplatGrads& grads,
                      const GaussianGrads& out, Stream stream) {
    if (gaussians.N == 0) return;
    launch(project_backward_kernel, blocks_for(gaussians.N), THREADS, stream, gaussians, cameras, grads, out);
}

void flag_values(const Values& v, int64_t* flags, Stream stream) {
    const Ranges ranges{{{v.means, v.N * 3, 1, -FLT_MAX, FLT_MAX, 0},
                         {v.factors, v.N * 9, 1, -FLT_MAX, FLT_MAX, 1},
                         {v.opacities, v.N, 1, 0.0f, 1.0f, 2},
                         {v.color, v.colors, 1, -FLT_MAX, FLT_MAX, 3},
                         {v.viewmats, v.C * 16, 1, -FLT_MAX, FLT_MAX, 4},
                         {v.Ks, v.C * 9, 1, -FLT_MAX, FLT_MAX, 5},
                         {v.Ks, v.C, 9, FLT_MIN, FLT_MAX, 5},  // focal lengths
                         {v.Ks + 4, v.C, 9, FLT_MIN, FLT_MAX, 5},
                         {v.background, v.D, 1, -FLT_MAX, FLT_MAX, 6}}};
    constexpr unsigned MOST_BLOCKS = 512;
    const unsigned blocks = blocks_for(v.N * 9) + 1;
    launch(flag_kernel, blocks < MOST_BLOCKS ? blocks : MOST_BLOCKS, THREADS, stream, ranges, flags);
}

}  // namespace gsb::cuda
