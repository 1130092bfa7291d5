// Projects Gaussians in float64, eight at a time, and joins each with its projection in float32; math/projection.h has
// the formulas.
#include "../math/projection.h"
#include "../math/rounding.h"

#include "doubles.h"
#include "isa.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr double BEYOND = 32;    // pixels outside of the image where boxes end
constexpr double MARGIN = 0.05;  // pixels: more than the rounding of boxes

// The part of an axis of the image, which is `size` pixels long, that boxes cover.
struct Span {
    const double size;
    double low = size + BEYOND, high = -BEYOND;

    void add(double center, double half) {
        low = min(low, max(center - half, -BEYOND));
        high = max(high, min(center + half, size + BEYOND));
    }
    float center() const { return static_cast<float>((low + high) / 2); }
    float half() const { return static_cast<float>((high - low) / 2 + MARGIN); }

private:
    static double min(double a, double b) { return a < b ? a : b; }
    static double max(double a, double b) { return a > b ? a : b; }
};

// Returns eight projected Gaussians from the i-th on, of which n exist.
template <class Profile>
Splat<Doubles> project_eight(const ExactProjectArgs& a, const CameraOf<double>& camera, int64_t i, int n) {
    const auto mean = [&](int k) { return gather(a.means + i * 3 + k, 3, n); };
    const auto factor = [&](int k) { return gather(a.factors + i * 9 + k, 9, n); };
    const Vec3<Doubles> rows[3] = {
        {factor(0), factor(1), factor(2)}, {factor(3), factor(4), factor(5)}, {factor(6), factor(7), factor(8)}};
    Projection<Doubles, double> projection(camera, {mean(0), mean(1), mean(2)}, rows, gather(a.opacities + i, 1, n));
    if constexpr (Profile::HAS_SHAPE) return projection.template splat<Profile>(gather(a.shapes + i, 1, n));
    return projection.template splat<Profile>();
}

// Joins Gaussian i in float64, which is one lane of `splats`, with the same in float32.
void join(const ExactProjectArgs& a, const double (&splats)[9][DOUBLES], int lane, int64_t i, const ExactSplats& out) {
    const auto own = [&](int k) { return splats[k][lane]; };
    const float *mean = a.means2d + i * 2, *root = a.roots + i * 4, *half = a.half_sizes + i * 2;
    const double depth = own(6), single_depth = a.depths[i], size = single_depth < 0 ? -single_depth : single_depth;
    const double away = single_depth < depth ? depth - single_depth : single_depth - depth, error = away + 2 * U * size;
    const bool sure = half[0] > 0 && single_depth - error > a.near && single_depth + error < a.far;
    out.records[i] = {{own(0), own(1), own(2), own(3), own(4), own(5), a.shapes ? a.shapes[i] : 1},
                      depth,
                      own(7),
                      error,
                      {mean[0], mean[1], root[0], root[1], root[2], root[3], a.shapes ? a.single_shapes[i] : 1},
                      half[0],
                      half[1],
                      sure};
    Span spans[2] = {{static_cast<double>(a.width)}, {static_cast<double>(a.height)}};
    for (int k = 0; k < 2; ++k) {
        if (own(7) > 0) spans[k].add(own(k), own(7 + k));
        if (half[0] > 0) spans[k].add(mean[k], half[k]);
    }
    const bool drawn = spans[0].low < spans[0].high && spans[1].low < spans[1].high;
    for (int k = 0; k < 2; ++k) {
        out.means2d[i * 2 + k] = spans[k].center();
        out.half_sizes[i * 2 + k] = drawn ? spans[k].half() : 0;
    }
    out.depths[i] = static_cast<float>(depth);
}

template <class Profile>
void exact_splats_as(const ExactProjectArgs& a, const ExactSplats& out) {
    const CameraOf<double> camera = camera_of<double>(a, 0);
#pragma omp parallel for num_threads(a.threads) schedule(static)
    for (int64_t i = 0; i < a.N; i += DOUBLES) {
        const int n = static_cast<int>(a.N - i < DOUBLES ? a.N - i : DOUBLES);
        const Splat<Doubles> s = project_eight<Profile>(a, camera, i, n);
        const Doubles columns[9] = {s.x, s.y, s.p, s.q, s.r, s.opacity, s.depth, s.half_x, s.half_y};
        alignas(64) double splats[9][DOUBLES];
        for (int k = 0; k < 9; ++k) columns[k].store(splats[k]);
        for (int lane = 0; lane < n; ++lane) join(a, splats, lane, i + lane, out);
    }
}

}  // namespace

void exact_splats(const ExactProjectArgs& a, const ExactSplats& out) {
    a.shapes ? exact_splats_as<Beta>(a, out) : exact_splats_as<Gaussian>(a, out);
}

}  // namespace GSB_ISA
}  // namespace gsb
