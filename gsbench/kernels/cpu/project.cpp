// Projects Gaussians to the image planes of all cameras, sixteen at a time; math/projection.h has the formulas.
#include "../math/projection.h"

#include "buffer.h"
#include "isa.h"
#include "rows.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int64_t CHUNK = 512;  // Gaussians a task; camera gradients are summed by chunks, whatever the thread count

// Returns the index of a camera's first Gaussian.
int64_t first_of(const ProjectArgs& a, int64_t camera) { return a.gaussian_per_camera ? camera * a.N : 0; }

Projection<Vec> load(const ProjectArgs& a, const Camera& camera, int64_t i, int n) {
    Vec mean[3], f[3][3];
    gather_row(a.means, i, n, mean);
    gather_matrix(a.factors, i, n, f);
    const Vec3<Vec> factor[3] = {{f[0][0], f[0][1], f[0][2]}, {f[1][0], f[1][1], f[1][2]}, {f[2][0], f[2][1], f[2][2]}};
    return Projection<Vec>(camera, {mean[0], mean[1], mean[2]}, factor, load_first(a.opacities + i, n));
}

Splat<Vec> load_splat(const SplatGrads& s, int64_t i, int n) {
    Vec mean[2], root[4];
    gather_row(s.means2d, i, n, mean);
    gather_row(s.roots, i, n, root);
    Splat<Vec> out;
    out.x = mean[0];
    out.y = mean[1];
    out.p = root[0];
    out.q = root[1];
    out.r = root[2];
    out.opacity = root[3];
    out.depth = s.depths ? load_first(s.depths + i, n) : Vec(0.0f);
    return out;
}

void store_splat(const Splat<Vec>& s, const Splats& out, int64_t i, int n) {
    scatter_row({s.x, s.y}, out.means2d, i, n);
    scatter_row({s.p, s.q, s.r, s.opacity}, out.roots, i, n);
    store_first(s.depth, out.depths + i, n);
    scatter_row({s.half_x, s.half_y}, out.half_sizes, i, n);
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

// Computes the splats of n Gaussians from the i-th on; `projection` is one of them.
template <class Profile>
Splat<Vec> splat_of(Projection<Vec>& projection, const ProjectArgs& a, int64_t i, int n) {
    if constexpr (Profile::HAS_SHAPE) return projection.splat<Profile>(load_first(a.shapes + i, n));
    return projection.splat<Profile>();
}

template <class Profile>
void project_as(const ProjectArgs& a, const Splats& out) {
    for (int64_t c = 0; c < a.C; ++c) {
        const Camera camera = camera_of(a, c);
        const int64_t first = first_of(a, c);
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N > CHUNK)
        for (int64_t i = 0; i < a.N; i += LANES) {
            const int n = lanes_from(i, a.N);
            if (!any(load_first(a.opacities + first + i, n) >= Vec(ALPHA_MIN))) {  // nothing that is drawn, whatever the rest
                store_nothing(out, c * a.N + i, n);
                continue;
            }
            Projection<Vec> projection = load(a, camera, first + i, n);
            store_splat(splat_of<Profile>(projection, a, first + i, n), out, c * a.N + i, n);
        }
    }
}

template <class Profile>
void project_backward_as(const ProjectArgs& a, const SplatGrads& grads, const ProjectGrads& out) {
    const int64_t chunks = (a.N + CHUNK - 1) / CHUNK, written = 13 * a.N * (a.gaussian_per_camera ? a.C : 1);
    Buffer<float> camera_grads(static_cast<size_t>(chunks * a.C * 12));
#pragma omp parallel for num_threads(a.threads) schedule(static) if (chunks > 1)
    for (int64_t chunk = 0; chunk < chunks; ++chunk) {
        const int64_t begin = chunk * CHUNK, end = begin + CHUNK < a.N ? begin + CHUNK : a.N;
        for (int64_t c = 0; c < a.C; ++c) {
            const Camera camera = camera_of(a, c);
            const bool adds = c > 0 && !a.gaussian_per_camera;  // to the gradients by the cameras before
            Vec3<Vec> g_view[4] = {};
            for (auto& row : g_view) row = {Vec(0.0f), Vec(0.0f), Vec(0.0f)};
            for (int64_t i = begin; i < end; i += LANES) {
                const int n = lanes_from(i, end);
                const int64_t at = first_of(a, c) + i;
                if (is_zero(grads, c * a.N + i, n)) {
                    if (adds) continue;
                    zero_rows(out.means, 3, at, at + n, written);
                    zero_rows(out.factors, 9, at, at + n, written);
                    zero_rows(out.opacities, 1, at, at + n, written);
                    continue;
                }
                Projection<Vec> projection = load(a, camera, at, n);
                const Splat<Vec> splat = splat_of<Profile>(projection, a, at, n);
                const Mask drawn = splat.half_x > Vec(0.0f);
                const Splat<Vec> g = load_splat(grads, c * a.N + i, n);
                const GaussianGrad<Vec> grad = projection.vjp(splat, g);
                const Vec3<Vec> m = masked(drawn, grad.mean);
                const Vec mean[3] = {m.x, m.y, m.z}, opacity = select(drawn, grad.opacity, Vec(0.0f));
                Vec factor[9];
                for (int k = 0; k < 3; ++k) {
                    const Vec3<Vec> row = masked(drawn, grad.factor[k]);
                    factor[k * 3] = row.x;
                    factor[k * 3 + 1] = row.y;
                    factor[k * 3 + 2] = row.z;
                }
                if (adds) {
                    add_row(mean, out.means, at, n);
                    add_row(factor, out.factors, at, n);
                    add_first(opacity, out.opacities + at, n);
                } else {
                    scatter_row(mean, out.means, at, n);
                    scatter_row(factor, out.factors, at, n);
                    store_first(opacity, out.opacities + at, n);
                }
                if (out.viewmats) {
                    for (int k = 0; k < 3; ++k) g_view[k] += masked(drawn, grad.rotation[k]);
                    g_view[3] += masked(drawn, grad.translation);
                }
            }
            finish_zeros();
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

}  // namespace

void project(const ProjectArgs& a, const Splats& out) {
    a.shapes ? project_as<Beta>(a, out) : project_as<Gaussian>(a, out);
}

void project_backward(const ProjectArgs& a, const SplatGrads& grads, const ProjectGrads& out) {
    a.shapes ? project_backward_as<Beta>(a, grads, out) : project_backward_as<Gaussian>(a, grads, out);
}

}  // namespace GSB_ISA
}  // namespace gsb
