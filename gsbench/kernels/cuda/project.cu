// Projects Gaussians to the image planes, and computes the gradients: one Gaussian and one camera per thread.
#include "../math/projection.h"

#include "launch.h"

namespace gsb::cuda {
namespace {

__device__ Vec3<float> vec3(const float* p) { return {p[0], p[1], p[2]}; }

__device__ void store(const Vec3<float>& v, float* p) { p[0] = v.x, p[1] = v.y, p[2] = v.z; }

// Returns the index of a camera's first Gaussian.
__device__ int64_t first_of(const ProjectArgs& a, int64_t camera) { return a.gaussian_per_camera ? camera * a.N : 0; }

__device__ Projection<float> projection_of(const ProjectArgs& a, const Camera& camera, int64_t i) {
    const float* F = a.factors + i * 9;
    const Vec3<float> factor[3] = {vec3(F), vec3(F + 3), vec3(F + 6)};
    return {camera, vec3(a.means + i * 3), factor, a.opacities[i]};
}

// Computes the splat of the i-th Gaussian; `projection` is its projection.
template <class Profile>
__device__ Splat<float> splat_of(Projection<float>& projection, const ProjectArgs& a, int64_t i) {
    if constexpr (Profile::HAS_SHAPE) return projection.splat<Profile>(a.shapes[i]);
    return projection.splat<Profile>();
}

template <class Profile>
__global__ void project_kernel(ProjectArgs a, Splats out) {
    const int64_t i = global_thread();
    if (i >= a.N) return;
    for (int64_t c = blockIdx.y; c < a.C; c += gridDim.y) {
        const Camera camera = camera_of(a, c);
        const int64_t gaussian = first_of(a, c) + i, at = c * a.N + i;
        Projection<float> projection = projection_of(a, camera, gaussian);
        const Splat<float> s = splat_of<Profile>(projection, a, gaussian);
        reinterpret_cast<float2*>(out.means2d)[at] = {s.x, s.y};
        reinterpret_cast<float4*>(out.roots)[at] = {s.p, s.q, s.r, s.opacity};
        reinterpret_cast<float2*>(out.half_sizes)[at] = {s.half_x, s.half_y};
        out.depths[at] = s.depth;
    }
}

__device__ Splat<float> splat_grad(const SplatGrads& g, int64_t at) {
    Splat<float> out{};
    out.x = g.means2d[at * 2], out.y = g.means2d[at * 2 + 1];
    const float4 root = reinterpret_cast<const float4*>(g.roots)[at];
    out.p = root.x, out.q = root.y, out.r = root.z, out.opacity = root.w;
    if (g.depths) out.depth = g.depths[at];
    return out;
}

// Adds a warp's sums to the gradient of one camera; `grad` is zero in lanes without a Gaussian.
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

// Writes the gradient of the i-th Gaussian.
__device__ void store_grad(const GaussianGrad<float>& grad, const ProjectGrads& out, int64_t i) {
    store(grad.mean, out.means + i * 3);
    for (int row = 0; row < 3; ++row) store(grad.factor[row], out.factors + i * 9 + row * 3);
    out.opacities[i] = grad.opacity;
}

template <class Profile>
__global__ void project_backward_kernel(ProjectArgs a, SplatGrads grads, ProjectGrads out) {
    const int64_t i = global_thread();
    const bool exists = i < a.N;
    GaussianGrad<float> sum{};
    for (int64_t c = blockIdx.y; c < a.C; c += gridDim.y) {
        GaussianGrad<float> grad{};
        if (exists) {
            const Camera camera = camera_of(a, c);
            const int64_t gaussian = first_of(a, c) + i;
            Projection<float> projection = projection_of(a, camera, gaussian);
            const Splat<float> splat = splat_of<Profile>(projection, a, gaussian);
            if (splat.half_x > 0.0f) grad = projection.vjp(splat, splat_grad(grads, c * a.N + i));
            if (a.gaussian_per_camera) store_grad(grad, out, gaussian);
        }
        sum.mean += grad.mean;
        for (int row = 0; row < 3; ++row) sum.factor[row] += grad.factor[row];
        sum.opacity += grad.opacity;
        if (out.viewmats) add_camera_grad(grad, out.viewmats + c * 16);
    }
    if (exists && !a.gaussian_per_camera) store_grad(sum, out, i);
}

}  // namespace

void project(const ProjectArgs& a, const Splats& out, Stream stream) {
    if (a.N == 0) return;
    const dim3 grid(blocks_for(a.N), rows_for(a.C));
    launch(a.shapes ? project_kernel<Beta> : project_kernel<Gaussian>, grid, THREADS, stream, a, out);
}

void project_backward(const ProjectArgs& a, const SplatGrads& grads, const ProjectGrads& out, Stream stream) {
    if (a.N == 0) return;
    // The gradients of a Gaussian that all cameras see are added up in one thread.
    const dim3 grid(blocks_for(a.N), a.gaussian_per_camera ? rows_for(a.C) : 1);
    launch(a.shapes ? project_backward_kernel<Beta> : project_backward_kernel<Gaussian>, grid, THREADS, stream, a,
           grads, out);
}

}  // namespace gsb::cuda
