// Gaussians to splats, sixteen at a time, for every camera; the mathematics is math/projection.h.
#include "../math/projection.h"

#include "buffer.h"
#include "isa.h"
#include "rows.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int64_t CHUNK = 512;  // Gaussians a task; camera gradients are summed by chunks, whatever the thread count

Camera camera_of(const ProjectArgs& a, int64_t c) {
    const float *view = a.viewmats + c * 16, *K = a.Ks + c * 9;
    Camera camera;
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) camera.rotation[i][j] = view[i * 4 + j];
        camera.translation[i] = view[i * 4 + 3];
    }
    camera.fx = K[0];
    camera.cx = K[2];
    camera.fy = K[4];
    camera.cy = K[5];
    camera.width = static_cast<float>(a.width);
    camera.height = static_cast<float>(a.height);
    camera.near = a.near;
    camera.far = a.far;
    camera.eps2d = a.eps2d;
    camera.antialias = a.antialias;
    return camera;
}

Vec3<Vec> gather3(const float* p, int stride, int n) {
    return {gather(p, stride, n), gather(p + 1, stride, n), gather(p + 2, stride, n)};
}

void scatter3(const Vec3<Vec>& v, float* p, int stride, int n) {
    scatter(v.x, p, stride, n);
    scatter(v.y, p + 1, stride, n);
    scatter(v.z, p + 2, stride, n);
}

Projection<Vec> load(const ProjectArgs& a, const Camera& camera, int64_t i, int n) {
    const float* f = a.factors + i * 9;
    const Vec3<Vec> factor[3] = {gather3(f, 9, n), gather3(f + 3, 9, n), gather3(f + 6, 9, n)};
    return Projection<Vec>(camera, gather3(a.means + i * 3, 3, n), factor, load_first(a.opacities + i, n));
}

Splat<Vec> load_splat(const SplatGrads& s, int64_t i, int n) {
    Splat<Vec> out;
    out.x = gather(s.means2d + i * 2, 2, n);
    out.y = gather(s.means2d + i * 2 + 1, 2, n);
    out.p = gather(s.roots + i * 4, 4, n);
    out.q = gather(s.roots + i * 4 + 1, 4, n);
    out.r = gather(s.roots + i * 4 + 2, 4, n);
    out.opacity = gather(s.roots + i * 4 + 3, 4, n);
    out.depth = s.depths ? load_first(s.depths + i, n) : Vec(0.0f);
    return out;
}

void store_splat(const Splat<Vec>& s, const Splats& out, int64_t i, int n) {
    scatter(s.x, out.means2d + i * 2, 2, n);
    scatter(s.y, out.means2d + i * 2 + 1, 2, n);
    scatter(s.p, out.roots + i * 4, 4, n);
    scatter(s.q, out.roots + i * 4 + 1, 4, n);
    scatter(s.r, out.roots + i * 4 + 2, 4, n);
    scatter(s.opacity, out.roots + i * 4 + 3, 4, n);
    store_first(s.depth, out.depths + i, n);
    scatter(s.half_x, out.half_sizes + i * 2, 2, n);
    scatter(s.half_y, out.half_sizes + i * 2 + 1, 2, n);
}

void store_nothing(const Splats& out, int64_t i, int n) {
    fill_zero(out.means2d, 2, i, i + n);
    fill_zero(out.roots, 4, i, i + n);
    fill_zero(out.depths, 1, i, i + n);
    fill_zero(out.half_sizes, 2, i, i + n);
}

bool is_zero(const SplatGrads& s, int64_t i, int n) {
    return all_zero(s.means2d, 2, i, n) && all_zero(s.roots, 4, i, n) && (!s.depths || all_zero(s.depths, 1, i, n));
}

Vec3<Vec> masked(Mask m, const Vec3<Vec>& v) {
    return {select(m, v.x, Vec(0.0f)), select(m, v.y, Vec(0.0f)), select(m, v.z, Vec(0.0f))};
}

}  // namespace

void project(const ProjectArgs& a, const Splats& out) {
    for (int64_t c = 0; c < a.C; ++c) {
        const Camera camera = camera_of(a, c);
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N > CHUNK)
        for (int64_t i = 0; i < a.N; i += LANES) {
            const int n = lanes_from(i, a.N);
            if (!any(load_first(a.opacities + i, n) >= Vec(ALPHA_MIN))) {  // nothing that is drawn, whatever the rest
                store_nothing(out, c * a.N + i, n);
                continue;
            }
            store_splat(load(a, camera, i, n).splat(), out, c * a.N + i, n);
        }
    }
}

void project_backward(const ProjectArgs& a, const SplatGrads& grads, const ProjectGrads& out) {
    const int64_t chunks = (a.N + CHUNK - 1) / CHUNK;
    Buffer<float> camera_grads(static_cast<size_t>(chunks * a.C * 12));
#pragma omp parallel for num_threads(a.threads) schedule(static) if (chunks > 1)
    for (int64_t chunk = 0; chunk < chunks; ++chunk) {
        const int64_t begin = chunk * CHUNK, end = begin + CHUNK < a.N ? begin + CHUNK : a.N;
        for (int64_t c = 0; c < a.C; ++c) {
            const Camera camera = camera_of(a, c);
            Vec3<Vec> g_view[4] = {};
            for (auto& row : g_view) row = {Vec(0.0f), Vec(0.0f), Vec(0.0f)};
            for (int64_t i = begin; i < end; i += LANES) {
                const int n = lanes_from(i, end);
                if (is_zero(grads, c * a.N + i, n)) {
                    if (c > 0) continue;
                    fill_zero(out.means, 3, i, i + n);
                    fill_zero(out.factors, 9, i, i + n);
                    fill_zero(out.opacities, 1, i, i + n);
                    continue;
                }
                Projection<Vec> projection = load(a, camera, i, n);
                const Splat<Vec> splat = projection.splat();
                const Mask drawn = splat.half_x > Vec(0.0f);
                const Splat<Vec> g = load_splat(grads, c * a.N + i, n);
                const GaussianGrad<Vec> grad = projection.vjp(splat, g);
                Vec3<Vec> mean = masked(drawn, grad.mean), factor[3];
                for (int k = 0; k < 3; ++k) factor[k] = masked(drawn, grad.factor[k]);
                Vec opacity = select(drawn, grad.opacity, Vec(0.0f));
                if (c > 0) {
                    mean += gather3(out.means + i * 3, 3, n);
                    for (int k = 0; k < 3; ++k) factor[k] += gather3(out.factors + i * 9 + k * 3, 9, n);
                    opacity += load_first(out.opacities + i, n);
                }
                scatter3(mean, out.means + i * 3, 3, n);
                for (int k = 0; k < 3; ++k) scatter3(factor[k], out.factors + i * 9 + k * 3, 9, n);
                store_first(opacity, out.opacities + i, n);
                if (out.viewmats) {
                    for (int k = 0; k < 3; ++k) g_view[k] += masked(drawn, grad.rotation[k]);
                    g_view[3] += masked(drawn, grad.translation);
                }
            }
            if (!out.viewmats) continue;
            float* g = &camera_grads[static_cast<size_t>((chunk * a.C + c) * 12)];
            for (int k = 0; k < 4; ++k, g += 3) {
                g[0] = sum(g_view[k].x);
                g[1] = sum(g_view[k].y);
                g[2] = sum(g_view[k].z);
            }
        }
    }
    if (!out.viewmats) return;
    for (int64_t c = 0; c < a.C; ++c) {
        double total[12] = {};
        for (int64_t chunk = 0; chunk < chunks; ++chunk) {
            for (int k = 0; k < 12; ++k) total[k] += camera_grads[static_cast<size_t>((chunk * a.C + c) * 12 + k)];
        }
        float* g = out.viewmats + c * 16;
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) g[i * 4 + j] = static_cast<float>(total[i * 3 + j]);
            g[i * 4 + 3] = static_cast<float>(total[9 + i]);
        }
        for (int j = 0; j < 4; ++j) g[12 + j] = 0.0f;
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
