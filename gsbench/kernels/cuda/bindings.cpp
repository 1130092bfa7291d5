// The door between Python and the CUDA kernels. Tensors cross as addresses, not as arrays: a DLPack capsule costs
// microseconds for each, as much as the kernels themselves take. gsbench/kernels/cuda/*.py checks what it passes.
#include <nanobind/nanobind.h>
#include <nanobind/stl/vector.h>

#include "kernels.h"
#include "sort.h"

namespace nb = nanobind;

namespace {

// A device pointer or stream of whatever type is wanted, an int in Python; 0 is null.
struct Address {
    uintptr_t value;

    template <class T>
    operator T*() const {
        return reinterpret_cast<T*>(value);
    }
};

}  // namespace

namespace nanobind::detail {

template <>
struct type_caster<Address> {
    NB_TYPE_CASTER(Address, const_name("int"))

    bool from_python(handle source, uint8_t flags, cleanup_list* cleanup) noexcept {
        make_caster<uintptr_t> number;
        if (!number.from_python(source, flags, cleanup)) return false;
        value.value = number.value;
        return true;
    }
};

}  // namespace nanobind::detail

namespace {

using gsb::cuda::BinArgs;
using gsb::cuda::BlendArgs;
using gsb::cuda::Cameras;
using gsb::cuda::Gaussians;

void flag_values(int64_t N, int64_t C, int64_t colors, int D, Address means, Address factors, Address opacities,
                 Address color, Address viewmats, Address Ks, Address background, Address flags, Address stream) {
    gsb::cuda::flag_values({N, C, colors, D, means, factors, opacities, color, viewmats, Ks, background}, flags, stream);
}

void project(int64_t N, Address means, Address factors, Address opacities, int64_t C, Address viewmats, Address Ks,
             int width, int height, float near, float far, float eps2d, bool antialias, Address means2d, Address roots,
             Address depths, Address half_sizes, Address stream) {
    gsb::cuda::project({N, means, factors, opacities}, {C, viewmats, Ks, width, height, near, far, eps2d, antialias},
                       {means2d, roots, depths, half_sizes}, stream);
}

void project_backward(int64_t N, Address means, Address factors, Address opacities, int64_t C, Address viewmats,
                      Address Ks, int width, int height, float near, float far, float eps2d, bool antialias,
                      Address g_means2d, Address g_roots, Address g_depths, Address out_means, Address out_factors,
                      Address out_opacities, Address out_viewmats, Address stream) {
    gsb::cuda::project_backward({N, means, factors, opacities},
                                {C, viewmats, Ks, width, height, near, far, eps2d, antialias},
                                {g_means2d, g_roots, g_depths},
                                {out_means, out_factors, out_opacities, out_viewmats}, stream);
}

void count_tiles(int64_t N, int64_t C, Address means2d, Address roots, Address depths, Address half_sizes, int width,
                 int height, Address keys, Address indices, Address sorted_keys, Address order, Address ends,
                 Address scratch, size_t bytes, Address stream) {
    gsb::cuda::count_tiles({N, C, means2d, roots, depths, half_sizes, width, height}, keys, indices, sorted_keys, order,
                           ends, scratch, bytes, stream);
}

void fill_tiles(int64_t N, int64_t C, Address means2d, Address roots, Address depths, Address half_sizes, int width,
                int height, Address order, Address ends, int64_t pairs, Address tiles, Address splats,
                Address sorted_tiles, Address ids, Address offsets, Address scratch, size_t bytes, Address stream) {
    gsb::cuda::fill_tiles({N, C, means2d, roots, depths, half_sizes, width, height}, order, ends, pairs, tiles, splats,
                          sorted_tiles, ids, offsets, scratch, bytes, stream);
}

void blend(int64_t N, int64_t C, int D, bool color_per_camera, Address means2d, Address roots, Address colors,
           Address background, Address offsets, Address ids, int width, int height, Address image, Address alpha,
           Address transmittance, Address stop, Address stream) {
    gsb::cuda::blend({N, C, D, color_per_camera, means2d, roots, colors, background, offsets, ids, width, height},
                     {image, alpha, transmittance, stop}, stream);
}

void blend_backward(int64_t N, int64_t C, int D, bool color_per_camera, Address means2d, Address roots, Address colors,
                    Address background, Address offsets, Address ids, int width, int height, Address transmittance,
                    Address stop, Address g_image, Address g_alpha, Address sums, Address out_means2d,
                    Address out_roots, Address out_colors, bool by_splat, Address stream) {
    gsb::cuda::blend_backward(
        {N, C, D, color_per_camera, means2d, roots, colors, background, offsets, ids, width, height},
        {nullptr, nullptr, transmittance, stop}, {g_image, g_alpha, sums, out_means2d, out_roots, out_colors}, by_splat,
        stream);
}

gsb::cuda::TriangularArgs triangular_args(int64_t N, bool conditioned_first, int form, float half, Address time,
                                          Address lambda_d, Address lambda_t, Address center, Address means,
                                          Address directions, Address times, Address log_diagonal, Address shape,
                                          Address motion, Address coupling, Address opacities) {
    return {N, conditioned_first, static_cast<gsb::OffDiagonal>(form), half, time, lambda_d, lambda_t, center, means,
            directions, times, log_diagonal, shape, motion, coupling, opacities};
}

void observe_triangular(int64_t N, bool conditioned_first, int form, float half, Address time, Address lambda_d,
                        Address lambda_t, Address center, Address means, Address directions, Address times,
                        Address log_diagonal, Address shape, Address motion, Address coupling, Address opacities,
                        Address out_means, Address out_factors, Address out_opacities, Address stream) {
    gsb::cuda::observe_triangular(
        triangular_args(N, conditioned_first, form, half, time, lambda_d, lambda_t, center, means, directions, times,
                        log_diagonal, shape, motion, coupling, opacities),
        {out_means, out_factors, out_opacities}, stream);
}

void observe_triangular_backward(int64_t N, bool conditioned_first, int form, float half, Address time,
                                 Address lambda_d, Address lambda_t, Address center, Address means, Address directions,
                                 Address times, Address log_diagonal, Address shape, Address motion,
                                 Address coupling, Address opacities,
                                 Address g_means, Address g_factors, Address g_opacities, Address out_means,
                                 Address out_directions, Address out_times, Address out_log_diagonal,
                                 Address out_shape, Address out_motion, Address out_coupling, Address out_opacities,
                                 Address out_lambdas, Address stream) {
    gsb::cuda::observe_triangular_backward(
        triangular_args(N, conditioned_first, form, half, time, lambda_d, lambda_t, center, means, directions, times,
                        log_diagonal, shape, motion, coupling, opacities),
        {g_means, g_factors, g_opacities},
        {out_means, out_directions, out_times, out_log_diagonal, out_shape, out_motion, out_coupling, out_opacities,
         out_lambdas}, stream);
}

void observe_rotated(int64_t N, Address time, Address lambda_t, Address means, Address times, Address scales,
                     Address left, Address right, Address opacities, Address out_means, Address out_factors,
                     Address out_opacities, Address stream) {
    gsb::cuda::observe_rotated({N, time, lambda_t, means, times, scales, left, right, opacities},
                               {out_means, out_factors, out_opacities}, stream);
}

void observe_rotated_backward(int64_t N, Address time, Address lambda_t, Address means, Address times, Address scales,
                              Address left, Address right, Address opacities, Address g_means, Address g_factors,
                              Address g_opacities, Address out_means, Address out_times, Address out_scales,
                              Address out_left, Address out_right, Address out_opacities, Address out_lambda_t,
                              Address stream) {
    gsb::cuda::observe_rotated_backward(
        {N, time, lambda_t, means, times, scales, left, right, opacities}, {g_means, g_factors, g_opacities},
        {out_means, out_times, out_scales, out_left, out_right, out_opacities, out_lambda_t}, stream);
}

void observe_still(int64_t N, Address scales, Address quats, Address opacities, Address out_factors,
                   Address out_opacities, Address stream) {
    gsb::cuda::observe_still({N, scales, quats, opacities}, {out_factors, out_opacities}, stream);
}

void observe_still_backward(int64_t N, Address scales, Address quats, Address opacities, Address g_factors,
                            Address g_opacities, Address out_scales, Address out_quats, Address out_opacities,
                            Address stream) {
    gsb::cuda::observe_still_backward({N, scales, quats, opacities}, {g_factors, g_opacities},
                                      {out_scales, out_quats, out_opacities}, stream);
}

void show_colors(int64_t N, int degree, int bases, int waves, Address sh0, Address shN, Address means,
                 Address opacities, Address times, Address center, Address time, Address colors, Address stream) {
    gsb::cuda::show_colors({N, degree, bases, waves, sh0, shN, means, opacities, times, center, time}, colors, stream);
}

void show_colors_backward(int64_t N, int degree, int bases, int waves, Address sh0, Address shN, Address means,
                          Address opacities, Address times, Address center, Address time, Address g_colors,
                          Address out_sh0, Address out_shN, Address out_means, Address out_times, Address stream) {
    gsb::cuda::show_colors_backward({N, degree, bases, waves, sh0, shN, means, opacities, times, center, time},
                                    {g_colors, out_sh0, out_shN, out_means, out_times}, stream);
}

// `from` and `to` are arrays [N, widths]: those that the networks move, in order; the first ones are the features.
struct RefineValues {
    std::vector<uintptr_t> from, to;
    std::vector<int> widths;

    gsb::cuda::Column column(size_t array, int c) const {
        return {reinterpret_cast<const float*>(from[array]) + c, to[array] ? reinterpret_cast<float*>(to[array]) + c : nullptr,
                widths[array]};
    }
};

gsb::cuda::RefineArgs refine_args(int64_t N, const std::vector<int>& widths, const RefineValues& read,
                                  const RefineValues& moved, Address weight_in, Address bias_in, Address weight_out,
                                  Address bias_out) {
    using namespace gsb::cuda;
    RefineArgs args{N, 0, static_cast<int>(widths.size()), 0, {}, {}, {}, weight_in, bias_in, weight_out, bias_out};
    const auto fits = [](bool good) { if (!good) throw nb::value_error("networks too large, or not of these values"); };
    fits(!widths.empty() && widths.size() <= MAX_NETWORKS && read.widths.size() >= widths.size());
    for (size_t array = 0; array + 1 < widths.size(); ++array) {  // the features: what all networks but the last move
        for (int c = 0; c < read.widths[array]; ++c) {
            fits(args.features_width < MAX_FEATURES - 1);
            args.features[args.features_width++] = read.column(array, c);
        }
    }
    size_t array = 0;
    for (size_t network = 0, c = 0; network < widths.size(); ++network) {
        fits(widths[network] <= MAX_WIDTH);
        args.outputs += args.widths[network] = widths[network];
        for (int k = 0; k < widths[network]; ++k, ++c) {
            if (c == static_cast<size_t>(moved.widths[array])) ++array, c = 0;
            fits(array < moved.widths.size());
            args.moved[network][k] = moved.column(array, static_cast<int>(c));
        }
    }
    return args;
}

void refine(int64_t N, const std::vector<int>& widths, const std::vector<int>& value_widths,
            const std::vector<uintptr_t>& values, Address weight_in, Address bias_in, Address weight_out,
            Address bias_out, const std::vector<uintptr_t>& out, Address stream) {
    const RefineValues moved{values, out, value_widths};
    gsb::cuda::refine(refine_args(N, widths, moved, moved, weight_in, bias_in, weight_out, bias_out), stream);
}

void refine_backward(int64_t N, const std::vector<int>& widths, const std::vector<int>& value_widths,
                     const std::vector<uintptr_t>& values, Address weight_in, Address bias_in, Address weight_out,
                     Address bias_out, const std::vector<uintptr_t>& g_out, const std::vector<uintptr_t>& out_features,
                     Address by_network, Address out_weight_in, Address out_bias_in, Address out_weight_out,
                     Address out_bias_out, Address stream) {
    const RefineValues moved{g_out, std::vector<uintptr_t>(g_out.size()), value_widths};
    const RefineValues read{values, out_features, value_widths};
    gsb::cuda::refine_backward(refine_args(N, widths, read, moved, weight_in, bias_in, weight_out, bias_out),
                               {by_network, out_weight_in, out_bias_in, out_weight_out, out_bias_out}, stream);
}

void l1_ssim(int height, int width, Address image, Address target, float ssim_weight, Address loss, Address derivatives,
             Address grad, Address stream) {
    gsb::cuda::l1_ssim({height, width, image, target, ssim_weight, loss, derivatives, grad}, stream);
}

void adam(int64_t N, int64_t width, Address drawn, Address gradients, Address parameters, Address means,
          Address squares, float rate, float beta1, float beta2, float log_beta1, float log_beta2, float eps,
          Address step, Address stream) {
    gsb::cuda::adam({N, width, drawn, gradients, parameters, means, squares, rate, beta1, beta2, log_beta1, log_beta2,
                     eps, step}, stream);
}

}  // namespace

NB_MODULE(GSB_MODULE, m) {
    m.def("scratch_bytes", &gsb::cuda::scratch_bytes, "Bytes that sorting and summing n items need.");
    m.def("similarity_blocks", &gsb::cuda::similarity_blocks, "Parts that l1_ssim leaves of its loss.");
    m.def("flag_values", &flag_values);
    m.def("project", &project);
    m.def("project_backward", &project_backward);
    m.def("count_tiles", &count_tiles);
    m.def("fill_tiles", &fill_tiles);
    m.def("blend", &blend);
    m.def("blend_backward", &blend_backward);
    m.def("observe_triangular", &observe_triangular);
    m.def("observe_triangular_backward", &observe_triangular_backward);
    m.def("observe_rotated", &observe_rotated);
    m.def("observe_rotated_backward", &observe_rotated_backward);
    m.def("observe_still", &observe_still);
    m.def("observe_still_backward", &observe_still_backward);
    m.def("show_colors", &show_colors);
    m.def("show_colors_backward", &show_colors_backward);
    m.def("refine", &refine);
    m.def("refine_backward", &refine_backward);
    m.attr("MAX_FEATURES") = gsb::cuda::MAX_FEATURES - 1;
    m.attr("MAX_NETWORKS") = gsb::cuda::MAX_NETWORKS;
    m.attr("MAX_WIDTH") = gsb::cuda::MAX_WIDTH;
    m.def("l1_ssim", &l1_ssim);
    m.def("adam", &adam);
}
