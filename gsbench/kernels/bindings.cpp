// The door between Python and the kernels: arrays cross by DLPack without a copy. A wrong dtype, rank, layout or device
// raises TypeError here, sizes that contradict each other ValueError; gsbench/kernels/__init__.py says it in words.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#if defined(__GLIBC__)
#include <malloc.h>
#endif

#include <optional>
#include <stdexcept>
#include <vector>

#include "cpu/dispatch.h"

namespace nb = nanobind;

namespace {

template <class T, nb::ssize_t... extents>
using Array = nb::ndarray<T, nb::shape<extents...>, nb::c_contig, nb::device::cpu>;
template <nb::ssize_t... extents>
using In = Array<const float, extents...>;
template <nb::ssize_t... extents>
using Out = Array<float, extents...>;

const gsb::Kernels* active = nullptr;

int64_t size(size_t n) { return static_cast<int64_t>(n); }

template <class... Sizes>
void expect_all(int64_t expected, const char* what, Sizes... sizes) {
    if (((static_cast<int64_t>(sizes) != expected) || ...)) {
        throw std::invalid_argument(std::string("arrays disagree on ") + what);
    }
}

struct Frame {
    int width, height, threads;

    Frame(int width, int height, int threads) : width(width), height(height), threads(threads) {
        if (width < 1 || height < 1 || threads < 1) throw std::invalid_argument("expected positive sizes and threads");
    }
};

gsb::ProjectArgs project_args(const In<-1, 3>& means, const In<-1, 3, 3>& factors, const In<-1>& opacities,
                              const In<-1, 4, 4>& viewmats, const In<-1, 3, 3>& Ks, int width, int height, double near,
                              double far, double eps2d, bool antialias, int threads) {
    const Frame frame(width, height, threads);
    const int64_t N = size(means.shape(0)), C = size(viewmats.shape(0));
    expect_all(N, "N", factors.shape(0), opacities.shape(0));
    expect_all(C, "C", Ks.shape(0));
    return {N, C, means.data(), factors.data(), opacities.data(), viewmats.data(), Ks.data(), width, height,
            static_cast<float>(near), static_cast<float>(far), static_cast<float>(eps2d), antialias, threads};
}

void project(In<-1, 3> means, In<-1, 3, 3> factors, In<-1> opacities, In<-1, 4, 4> viewmats, In<-1, 3, 3> Ks, int width,
             int height, double near, double far, double eps2d, bool antialias, int threads, Out<-1, -1, 2> means2d,
             Out<-1, -1, 3> roots, Out<-1, -1> out_opacities, Out<-1, -1> depths, Out<-1, -1, 2> half_sizes) {
    const auto args = project_args(means, factors, opacities, viewmats, Ks, width, height, near, far, eps2d, antialias,
                                   threads);
    expect_all(args.C * args.N, "C x N", means2d.size() / 2, roots.size() / 3, out_opacities.size(), depths.size(),
               half_sizes.size() / 2);
    nb::gil_scoped_release release;
    active->project(args, {means2d.data(), roots.data(), out_opacities.data(), depths.data(), half_sizes.data()});
}

void project_backward(In<-1, 3> means, In<-1, 3, 3> factors, In<-1> opacities, In<-1, 4, 4> viewmats, In<-1, 3, 3> Ks,
                      int width, int height, double near, double far, double eps2d, bool antialias, int threads,
                      In<-1, -1, 2> g_means2d, In<-1, -1, 3> g_roots, In<-1, -1> g_opacities, In<-1, -1> g_depths,
                      Out<-1, 3> out_means, Out<-1, 3, 3> out_factors, Out<-1> out_opacities,
                      Out<-1, 4, 4> out_viewmats) {
    const auto args = project_args(means, factors, opacities, viewmats, Ks, width, height, near, far, eps2d, antialias,
                                   threads);
    expect_all(args.C * args.N, "C x N", g_means2d.size() / 2, g_roots.size() / 3, g_opacities.size(), g_depths.size());
    expect_all(args.N, "N", out_means.shape(0), out_factors.shape(0), out_opacities.shape(0));
    const bool cameras = out_viewmats.shape(0) > 0;
    if (cameras) expect_all(args.C, "C", out_viewmats.shape(0));
    const auto mutable_of = [](const auto& array) { return const_cast<float*>(array.data()); };
    nb::gil_scoped_release release;
    active->project_backward(
        args, {mutable_of(g_means2d), mutable_of(g_roots), mutable_of(g_opacities), mutable_of(g_depths), nullptr},
        {out_means.data(), out_factors.data(), out_opacities.data(), cameras ? out_viewmats.data() : nullptr});
}

gsb::BinArgs bin_args(const In<-1, -1, 2>& means2d, const In<-1, -1>& depths, const In<-1, -1, 2>& half_sizes,
                      const Array<int64_t, -1>& offsets, int width, int height, int threads) {
    const Frame frame(width, height, threads);
    const int64_t C = size(means2d.shape(0)), N = size(means2d.shape(1));
    expect_all(C * N, "C x N", depths.size(), half_sizes.size() / 2);
    expect_all(C * gsb::tiles_along(width) * gsb::tiles_along(height) + 1, "the number of tiles", offsets.size());
    return {N, C, means2d.data(), depths.data(), half_sizes.data(), width, height, threads};
}

int64_t count_tiles(In<-1, -1, 2> means2d, In<-1, -1> depths, In<-1, -1, 2> half_sizes, int width, int height,
                    int threads, Array<int64_t, -1> offsets) {
    const auto args = bin_args(means2d, depths, half_sizes, offsets, width, height, threads);
    nb::gil_scoped_release release;
    return active->count_tiles(args, offsets.data());
}

void fill_tiles(In<-1, -1, 2> means2d, In<-1, -1> depths, In<-1, -1, 2> half_sizes, int width, int height, int threads,
                Array<int64_t, -1> offsets, Array<int32_t, -1> ids) {
    const auto args = bin_args(means2d, depths, half_sizes, offsets, width, height, threads);
    expect_all(offsets.data()[offsets.size() - 1], "the number of pairs", ids.size());
    nb::gil_scoped_release release;
    active->fill_tiles(args, offsets.data(), ids.data());
}

gsb::BlendArgs blend_args(const In<-1, -1, 2>& means2d, const In<-1, -1, 3>& roots, const In<-1, -1>& opacities,
                          const In<-1, -1, 2>& half_sizes, const In<-1, -1, -1>& colors, const In<-1>& background,
                          const Array<const int64_t, -1>& offsets, const Array<const int32_t, -1>& ids, int width,
                          int height, int threads) {
    const Frame frame(width, height, threads);
    const int64_t C = size(means2d.shape(0)), N = size(means2d.shape(1)), D = size(colors.shape(2));
    expect_all(C * N, "C x N", roots.size() / 3, opacities.size(), half_sizes.size() / 2);
    expect_all(N, "N", colors.shape(1));
    expect_all(D, "D", background.size());
    if (size(colors.shape(0)) != 1) expect_all(C, "C", colors.shape(0));
    expect_all(C * gsb::tiles_along(width) * gsb::tiles_along(height) + 1, "the number of tiles", offsets.size());
    expect_all(offsets.data()[offsets.size() - 1], "the number of pairs", ids.size());
    return {N, C, static_cast<int>(D), C > 1 && size(colors.shape(0)) == C, means2d.data(), roots.data(),
            opacities.data(), half_sizes.data(), colors.data(), background.data(), offsets.data(), ids.data(), width,
            height, threads};
}

void expect_state(const gsb::BlendArgs& args, size_t transmittance, size_t stop) {
    const int64_t tiles = args.C * gsb::tiles_along(args.width) * gsb::tiles_along(args.height);
    expect_all(tiles * gsb::TILE * gsb::TILE, "the tiles' state", transmittance, stop);
}

void blend(In<-1, -1, 2> means2d, In<-1, -1, 3> roots, In<-1, -1> opacities, In<-1, -1, 2> half_sizes,
           In<-1, -1, -1> colors, In<-1> background, Array<const int64_t, -1> offsets, Array<const int32_t, -1> ids,
           int width, int height, int threads, Out<-1, -1, -1, -1> image, Out<-1, -1, -1, 1> alpha,
           Out<-1> transmittance, Out<-1> stop) {
    const auto args = blend_args(means2d, roots, opacities, half_sizes, colors, background, offsets, ids, width, height,
                                 threads);
    expect_all(args.C * height * width, "the picture", image.size() / background.size(), alpha.size());
    expect_state(args, transmittance.size(), stop.size());
    nb::gil_scoped_release release;
    active->blend(args, {image.data(), alpha.data(), transmittance.data(), stop.data()});
}

void blend_backward(In<-1, -1, 2> means2d, In<-1, -1, 3> roots, In<-1, -1> opacities, In<-1, -1, 2> half_sizes,
                    In<-1, -1, -1> colors, In<-1> background, Array<const int64_t, -1> offsets,
                    Array<const int32_t, -1> ids, int width, int height, int threads, Out<-1> transmittance,
                    Out<-1> stop, In<-1, -1, -1, -1> g_image, In<-1, -1, -1, 1> g_alpha, Out<-1, -1, 2> out_means2d,
                    Out<-1, -1, 3> out_roots, Out<-1, -1> out_opacities, Out<-1, -1, -1> out_colors,
                    Out<-1> out_background) {
    const auto args = blend_args(means2d, roots, opacities, half_sizes, colors, background, offsets, ids, width, height,
                                 threads);
    expect_all(args.C * height * width, "the picture", g_image.size() / background.size(), g_alpha.size());
    expect_all(args.C * args.N, "C x N", out_means2d.size() / 2, out_roots.size() / 3, out_opacities.size());
    expect_all(size(colors.size()), "the colours", out_colors.size());
    expect_all(args.D, "D", out_background.size());
    expect_state(args, transmittance.size(), stop.size());
    nb::gil_scoped_release release;
    active->blend_backward(args, {nullptr, nullptr, transmittance.data(), stop.data()},
                           {g_image.data(), g_alpha.data(), out_means2d.data(), out_roots.data(), out_opacities.data(),
                            out_colors.data(), out_background.data()});
}

double l1_ssim(In<-1, -1, 3> image, In<-1, -1, 3> target, double ssim_weight, int threads, Out<-1, -1, 3> grad) {
    const Frame frame(static_cast<int>(image.shape(1)), static_cast<int>(image.shape(0)), threads);
    expect_all(frame.height, "the height", target.shape(0));
    expect_all(frame.width, "the width", target.shape(1));
    if (grad.size() > 0) expect_all(size(image.size()), "the gradient's size", grad.size());
    float* g = grad.size() > 0 ? grad.data() : nullptr;
    nb::gil_scoped_release release;
    return active->l1_ssim(
        {frame.height, frame.width, image.data(), target.data(), static_cast<float>(ssim_weight), g, threads});
}

gsb::TriangularArgs triangular_args(const In<-1, 3>& means, const In<-1, 3>& directions, const In<-1>& times,
                                    const In<-1, -1>& log_diagonal, const In<-1, 3>& shape,
                                    const In<-1, -1>& motion, const In<-1, -1>& coupling,
                                    const In<-1>& opacities, const In<3>& center, double time, double lambda_d,
                                    double lambda_t, double half, bool conditioned_first, int form, bool subtracts,
                                    int threads) {
    const int64_t N = size(means.shape(0)), n = size(log_diagonal.shape(1)), k = n - 3;
    const bool has_time = n == 7;
    if (n != 6 && n != 7) throw std::invalid_argument("expected a factor of 6 or 7 rows");
    expect_all(N, "N", directions.shape(0), log_diagonal.shape(0), shape.shape(0), motion.shape(0), coupling.shape(0),
               opacities.shape(0));
    expect_all(has_time ? N : 0, "times", times.shape(0));
    expect_all(3 * k, "the entries of motion", motion.shape(1));
    expect_all(k * (k - 1) / 2, "the entries of coupling", coupling.shape(1));
    const Frame frame(1, 1, threads);
    const float *at = center.data(), *t = has_time ? times.data() : nullptr;
    return {N, conditioned_first, static_cast<gsb::OffDiagonal>(form), subtracts, static_cast<float>(half),
            static_cast<float>(lambda_d), static_cast<float>(lambda_t), static_cast<float>(time),
            {at[0], at[1], at[2]}, means.data(), directions.data(), t, log_diagonal.data(), shape.data(), motion.data(),
            coupling.data(), opacities.data(), threads};
}

void observe_triangular(In<-1, 3> means, In<-1, 3> directions, In<-1> times, In<-1, -1> log_diagonal,
                        In<-1, 3> shape, In<-1, -1> motion, In<-1, -1> coupling, In<-1> opacities, In<3> center,
                        double time, double lambda_d, double lambda_t, double half, bool conditioned_first, int form,
                        bool subtracts, int threads, Out<-1, 3> out_means, Out<-1, 3, 3> out_factors, Out<-1> out_opacities) {
    const auto args = triangular_args(means, directions, times, log_diagonal, shape, motion, coupling, opacities, center,
                                      time, lambda_d, lambda_t, half, conditioned_first, form, subtracts, threads);
    expect_all(args.N, "N", out_means.shape(0), out_factors.shape(0), out_opacities.shape(0));
    nb::gil_scoped_release release;
    active->observe_triangular(args, {out_means.data(), out_factors.data(), out_opacities.data()});
}

void observe_triangular_backward(In<-1, 3> means, In<-1, 3> directions, In<-1> times, In<-1, -1> log_diagonal,
                                 In<-1, 3> shape, In<-1, -1> motion, In<-1, -1> coupling, In<-1> opacities,
                                 In<3> center, double time, double lambda_d, double lambda_t, double half,
                                 bool conditioned_first, int form, bool subtracts, int threads, Out<-1, 3> g_means, Out<-1, 3, 3> g_factors, Out<-1> g_opacities,
                                 Out<-1, 3> out_means, Out<-1, 3> out_directions, Out<-1> out_times,
                                 Out<-1, -1> out_log_diagonal, Out<-1, 3> out_shape, Out<-1, -1> out_motion,
                                 Out<-1, -1> out_coupling, Out<-1> out_opacities, Out<2> out_lambdas) {
    const auto args = triangular_args(means, directions, times, log_diagonal, shape, motion, coupling, opacities, center,
                                      time, lambda_d, lambda_t, half, conditioned_first, form, subtracts, threads);
    expect_all(args.N, "N", g_means.shape(0), g_factors.shape(0), g_opacities.shape(0), out_means.shape(0),
               out_directions.shape(0), out_opacities.shape(0));
    expect_all(size(times.size()), "times", out_times.size());
    expect_all(size(log_diagonal.size()), "the diagonal", out_log_diagonal.size());
    expect_all(args.N, "N", out_shape.shape(0));
    expect_all(size(motion.size()), "the entries of motion", out_motion.size());
    expect_all(size(coupling.size()), "the entries of coupling", out_coupling.size());
    gsb::TriangularGrads grads{out_means.data(), out_directions.data(), out_times.data(), out_log_diagonal.data(),
                               out_shape.data(), out_motion.data(), out_coupling.data(), out_opacities.data(), {}};
    {
        nb::gil_scoped_release release;
        active->observe_triangular_backward(args, {g_means.data(), g_factors.data(), g_opacities.data()}, grads);
    }
    out_lambdas.data()[0] = grads.lambdas[0];
    out_lambdas.data()[1] = grads.lambdas[1];
}

gsb::RotatedArgs rotated_args(const In<-1, 3>& means, const In<-1>& times, const In<-1, 4>& scales,
                              const In<-1, 4>& left, const In<-1, 4>& right, const In<-1>& opacities, double time,
                              double lambda_t, int threads) {
    const int64_t N = size(means.shape(0));
    expect_all(N, "N", times.shape(0), scales.shape(0), left.shape(0), right.shape(0), opacities.shape(0));
    const Frame frame(1, 1, threads);
    return {N, static_cast<float>(lambda_t), static_cast<float>(time), means.data(), times.data(), scales.data(),
            left.data(), right.data(), opacities.data(), threads};
}

void observe_rotated(In<-1, 3> means, In<-1> times, In<-1, 4> scales, In<-1, 4> left, In<-1, 4> right, In<-1> opacities,
                     double time, double lambda_t, int threads, Out<-1, 3> out_means, Out<-1, 3, 3> out_factors,
                     Out<-1> out_opacities) {
    const auto args = rotated_args(means, times, scales, left, right, opacities, time, lambda_t, threads);
    expect_all(args.N, "N", out_means.shape(0), out_factors.shape(0), out_opacities.shape(0));
    nb::gil_scoped_release release;
    active->observe_rotated(args, {out_means.data(), out_factors.data(), out_opacities.data()});
}

double observe_rotated_backward(In<-1, 3> means, In<-1> times, In<-1, 4> scales, In<-1, 4> left, In<-1, 4> right,
                                In<-1> opacities, double time, double lambda_t, int threads, Out<-1, 3> g_means,
                                Out<-1, 3, 3> g_factors, Out<-1> g_opacities, Out<-1, 3> out_means, Out<-1> out_times,
                                Out<-1, 4> out_scales, Out<-1, 4> out_left, Out<-1, 4> out_right,
                                Out<-1> out_opacities) {
    const auto args = rotated_args(means, times, scales, left, right, opacities, time, lambda_t, threads);
    expect_all(args.N, "N", g_means.shape(0), g_factors.shape(0), g_opacities.shape(0), out_means.shape(0),
               out_times.shape(0), out_scales.shape(0), out_left.shape(0), out_right.shape(0), out_opacities.shape(0));
    gsb::RotatedGrads grads{out_means.data(), out_times.data(), out_scales.data(), out_left.data(), out_right.data(),
                            out_opacities.data(), 0.0f};
    nb::gil_scoped_release release;
    active->observe_rotated_backward(args, {g_means.data(), g_factors.data(), g_opacities.data()}, grads);
    return grads.lambda_t;
}

gsb::StillArgs still_args(const In<-1, 3>& scales, const In<-1, 4>& quats, const In<-1>& opacities, int threads) {
    const int64_t N = size(scales.shape(0));
    expect_all(N, "N", quats.shape(0), opacities.shape(0));
    const Frame frame(1, 1, threads);
    return {N, scales.data(), quats.data(), opacities.data(), threads};
}

void observe_still(In<-1, 3> scales, In<-1, 4> quats, In<-1> opacities, int threads, Out<-1, 3, 3> out_factors,
                   Out<-1> out_opacities) {
    const auto args = still_args(scales, quats, opacities, threads);
    expect_all(args.N, "N", out_factors.shape(0), out_opacities.shape(0));
    nb::gil_scoped_release release;
    active->observe_still(args, {out_factors.data(), out_opacities.data()});
}

void observe_still_backward(In<-1, 3> scales, In<-1, 4> quats, In<-1> opacities, int threads, Out<-1, 3, 3> g_factors,
                            Out<-1> g_opacities, Out<-1, 3> out_scales, Out<-1, 4> out_quats, Out<-1> out_opacities) {
    const auto args = still_args(scales, quats, opacities, threads);
    expect_all(args.N, "N", g_factors.shape(0), g_opacities.shape(0), out_scales.shape(0), out_quats.shape(0),
               out_opacities.shape(0));
    nb::gil_scoped_release release;
    active->observe_still_backward(args, {g_factors.data(), g_opacities.data()},
                                   {out_scales.data(), out_quats.data(), out_opacities.data()});
}

gsb::ColorArgs color_args(const In<-1, -1, 3>& sh0, const In<-1, -1, 3>& shN, const In<-1, 3>& means,
                          const In<-1>& opacities, const In<-1>& times, const In<3>& center, double time, int degree,
                          int waves, int threads) {
    const int64_t N = size(means.shape(0)), all = size(shN.shape(1)) + 1;
    if (degree < 0 || degree > 3 || waves < 1 || waves > 8 || all % waves || all / waves < (degree + 1) * (degree + 1)) {
        throw std::invalid_argument("degree, waves and the number of coefficients do not fit");
    }
    expect_all(N, "N", sh0.shape(0), shN.shape(0), opacities.shape(0));
    expect_all(1, "the constant coefficient", sh0.shape(1));
    if (waves > 1) expect_all(N, "times", times.shape(0));
    const Frame frame(1, 1, threads);
    const float* at = center.data();
    return {N, degree, static_cast<int>(all / waves), waves, sh0.data(), shN.data(), means.data(), opacities.data(),
            waves > 1 ? times.data() : nullptr, static_cast<float>(time), {at[0], at[1], at[2]}, threads};
}

void show_colors(In<-1, -1, 3> sh0, In<-1, -1, 3> shN, In<-1, 3> means, In<-1> opacities, In<-1> times, In<3> center,
                 double time, int degree, int waves, int threads, Out<-1, 3> colors) {
    const auto args = color_args(sh0, shN, means, opacities, times, center, time, degree, waves, threads);
    expect_all(args.N, "N", colors.shape(0));
    nb::gil_scoped_release release;
    active->show_colors(args, colors.data());
}

void show_colors_backward(In<-1, -1, 3> sh0, In<-1, -1, 3> shN, In<-1, 3> means, In<-1> opacities, In<-1> times,
                          In<3> center, double time, int degree, int waves, int threads, In<-1, 3> g_colors,
                          Out<-1, -1, 3> out_sh0, Out<-1, -1, 3> out_shN, Out<-1, 3> out_means, Out<-1> out_times,
                          std::optional<Array<const int64_t, -1>> rows) {
    const auto args = color_args(sh0, shN, means, opacities, times, center, time, degree, waves, threads);
    expect_all(args.N, "N", g_colors.shape(0), out_sh0.shape(0), out_means.shape(0));
    const int64_t count = rows ? size(rows->shape(0)) : args.N;
    expect_all(count, "the rows of the coefficients", out_shN.shape(0));
    expect_all(size(shN.shape(1)), "the coefficients", out_shN.shape(1));
    expect_all(args.times ? args.N : 0, "times", out_times.shape(0));
    for (int64_t k = 0; rows && k < count; ++k) {
        if ((*rows)(k) < (k ? (*rows)(k - 1) + 1 : 0) || (*rows)(k) >= args.N) {
            throw std::invalid_argument("expected rows in ascending order, each of a Gaussian");
        }
    }
    nb::gil_scoped_release release;
    active->show_colors_backward(
        args, {g_colors.data(), out_sh0.data(), out_shN.data(), out_means.data(), out_times.data(), rows.has_value(),
               rows ? rows->data() : nullptr, rows ? count : 0});
}

template <class T>
struct Rows {  // several arrays of N rows each
    std::vector<T*> data;
    std::vector<int> widths;

    explicit Rows(const std::vector<Array<T, -1, -1>>& arrays) {
        for (const auto& array : arrays) {
            expect_all(size(arrays[0].shape(0)), "N", array.shape(0));
            data.push_back(array.data());
            widths.push_back(static_cast<int>(array.shape(1)));
        }
    }
    int width(size_t first, size_t last) const {
        int sum = 0;
        for (size_t i = first; i < last && i < widths.size(); ++i) sum += widths[i];
        return sum;
    }
};

gsb::RefineArgs refine_args(const Rows<const float>& values, int64_t N, const In<-1, -1>& weight_in,
                            const In<-1>& bias_in, const In<-1, 64>& weight_out, const In<-1>& bias_out,
                            const std::vector<int>& widths, int threads) {
    const size_t networks = widths.size(), arrays = values.data.size();
    if (networks < 2 || arrays < networks) throw std::invalid_argument("expected a network for each feature, and one more");
    for (size_t i = 0; i + 1 < networks; ++i) expect_all(values.widths[i], "the outputs", widths[i]);
    const int features = values.width(0, networks - 1), outputs = values.width(0, arrays);
    expect_all(outputs - features, "the outputs", widths[networks - 1]);
    expect_all(size(networks) * 64, "the hidden units", weight_in.shape(0), bias_in.shape(0));
    expect_all(features, "the features", weight_in.shape(1));
    expect_all(outputs, "the outputs", weight_out.shape(0), bias_out.shape(0));
    const Frame frame(1, 1, threads);
    return {N, features, static_cast<int>(networks), static_cast<int>(arrays), outputs, widths.data(),
            values.widths.data(), values.data.data(), weight_in.data(), bias_in.data(), weight_out.data(),
            bias_out.data(), threads};
}

void refine(std::vector<In<-1, -1>> values, In<-1, -1> weight_in, In<-1> bias_in, In<-1, 64> weight_out,
            In<-1> bias_out, std::vector<int> widths, int threads, std::vector<Out<-1, -1>> out) {
    const Rows<const float> in(values);
    const Rows<float> to(out);
    const int64_t N = values.empty() ? 0 : size(values[0].shape(0));
    const auto args = refine_args(in, N, weight_in, bias_in, weight_out, bias_out, widths, threads);
    if (to.widths != in.widths || size(out[0].shape(0)) != N) throw std::invalid_argument("arrays disagree on the values");
    nb::gil_scoped_release release;
    active->refine(args, to.data.data());
}

void refine_backward(std::vector<In<-1, -1>> values, In<-1, -1> weight_in, In<-1> bias_in, In<-1, 64> weight_out,
                     In<-1> bias_out, std::vector<int> widths, int threads, std::vector<In<-1, -1>> g_out,
                     std::vector<Out<-1, -1>> out_features, Out<-1, -1> out_weight_in, Out<-1> out_bias_in,
                     Out<-1, 64> out_weight_out, Out<-1> out_bias_out) {
    const Rows<const float> in(values), grads(g_out);
    const Rows<float> to(out_features);
    const int64_t N = values.empty() ? 0 : size(values[0].shape(0));
    const auto args = refine_args(in, N, weight_in, bias_in, weight_out, bias_out, widths, threads);
    const std::vector<int> features(in.widths.begin(), in.widths.begin() + args.networks - 1);
    if (grads.widths != in.widths || to.widths != features || size(g_out[0].shape(0)) != N ||
        size(out_features[0].shape(0)) != N) {
        throw std::invalid_argument("arrays disagree on the values");
    }
    expect_all(args.outputs, "the outputs", out_weight_out.shape(0), out_bias_out.shape(0));
    expect_all(size(weight_in.size()), "the weights", out_weight_in.size());
    expect_all(size(bias_in.size()), "the hidden units", out_bias_in.size());
    nb::gil_scoped_release release;
    active->refine_backward(args, grads.data.data(), {to.data.data(), out_weight_in.data(), out_bias_in.data(),
                                                      out_weight_out.data(), out_bias_out.data()});
}

void adam(Out<-1, -1> parameters, In<-1, -1> gradients, Out<-1, -1> means, Out<-1, -1> squares,
          Array<const bool, -1> drawn, double rate, double beta1, double beta2, double eps, double unbias1,
          double unbias2, int threads) {
    const int64_t N = size(parameters.shape(0)), width = size(parameters.shape(1));
    expect_all(N * width, "N x width", gradients.size(), means.size(), squares.size());
    expect_all(N, "N", drawn.shape(0));
    const Frame frame(1, 1, threads);
    const auto f = [](double x) { return static_cast<float>(x); };
    nb::gil_scoped_release release;
    active->adam({N, width, drawn.data(), gradients.data(), parameters.data(), means.data(), squares.data(),
                  {f(rate), f(beta1), f(beta2), f(eps), f(unbias1), f(unbias2)}, threads});
}

float roofline_flops(int64_t rounds) { return active->roofline_flops(rounds); }

float roofline_alphas(int64_t rounds) { return active->roofline_alphas(rounds); }

void roofline_triad(Out<-1> a, In<-1> b, In<-1> c) {
    expect_all(size(a.size()), "their length", b.size(), c.size());
    active->roofline_triad(a.data(), b.data(), c.data(), size(a.size()));
}

// Binds f so that no argument is converted or copied: what does not fit is refused.
template <class Result, class... Args>
void define(nb::module_& m, const char* name, Result (*f)(Args...)) {
    m.def(name, f, (static_cast<void>(sizeof(Args)), nb::arg().noconvert())...);
}

// A step frees 100 MB of gradients and asks for them again. By default the system takes large blocks back each time and
// maps them anew page by page, a quarter of a step of 4DGS at 150,000 Gaussians.
void keep_memory() {
#if defined(__GLIBC__)
    mallopt(M_MMAP_THRESHOLD, 1 << 30);
    mallopt(M_TRIM_THRESHOLD, 1 << 30);
#endif
}

}  // namespace

NB_MODULE(_native, m) {
    keep_memory();
    active = &gsb::kernels_of(gsb::instruction_sets().back());
    m.def("instruction_sets", &gsb::instruction_sets, "Those built in that run on this machine, the best last.");
    m.def("use", [](const std::string& isa) { active = &gsb::kernels_of(isa); }, "Switch to an instruction set.");
    m.def("active", [] { return std::string(active->isa); }, "The instruction set in use.");
    define(m, "project", project);
    define(m, "project_backward", project_backward);
    define(m, "count_tiles", count_tiles);
    define(m, "fill_tiles", fill_tiles);
    define(m, "blend", blend);
    define(m, "blend_backward", blend_backward);
    define(m, "l1_ssim", l1_ssim);
    define(m, "observe_triangular", observe_triangular);
    define(m, "observe_triangular_backward", observe_triangular_backward);
    define(m, "observe_rotated", observe_rotated);
    define(m, "observe_rotated_backward", observe_rotated_backward);
    define(m, "observe_still", observe_still);
    define(m, "observe_still_backward", observe_still_backward);
    define(m, "show_colors", show_colors);
    define(m, "show_colors_backward", show_colors_backward);
    define(m, "refine", refine);
    define(m, "refine_backward", refine_backward);
    define(m, "adam", adam);
    define(m, "roofline_flops", roofline_flops);
    define(m, "roofline_triad", roofline_triad);
    define(m, "roofline_alphas", roofline_alphas);
}
