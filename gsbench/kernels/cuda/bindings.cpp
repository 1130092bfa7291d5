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

gsb::cuda::TriangularArgs triangular_args(int64_t N, bool conditioned_first, bool row_scaled, float half, Address time,
                                          Address lambda_d, Address lambda_t, Address center, Address means,
                                          Address directions, Address times, Address log_diagonal, Address off_diagonal,
                                          Address opacities) {
    return {N, conditioned_first, row_scaled, half, time, lambda_d, lambda_t, center, means, directions, times,
            log_diagonal, off_diagonal, opacities};
}

void observe_triangular(int64_t N, bool conditioned_first, bool row_scaled, float half, Address time, Address lambda_d,
                        Address lambda_t, Address center, Address means, Address directions, Address times,
                        Address log_diagonal, Address off_diagonal, Address opacities, Address out_means,
                        Address out_factors, Address out_opacities, Address stream) {
    gsb::cuda::observe_triangular(
        triangular_args(N, conditioned_first, row_scaled, half, time, lambda_d, lambda_t, center, means, directions,
                        times, log_diagonal, off_diagonal, opacities),
        {out_means, out_factors, out_opacities}, stream);
}

void observe_triangular_backward(int64_t N, bool conditioned_first, bool row_scaled, float half, Address time,
                                 Address lambda_d, Address lambda_t, Address center, Address means, Address directions,
                                 Address times, Address log_diagonal, Address off_diagonal, Address opacities,
                                 Address g_means, Address g_factors, Address g_opacities, Address out_means,
                                 Address out_directions, Address out_times, Address out_log_diagonal,
                                 Address out_off_diagonal, Address out_opacities, Address out_lambdas, Address stream) {
    gsb::cuda::observe_triangular_backward(
        triangular_args(N, conditioned_first, row_scaled, half, time, lambda_d, lambda_t, center, means, directions,
                        times, log_diagonal, off_diagonal, opacities),
        {g_means, g_factors, g_opacities},
        {out_means, out_directions, out_times, out_log_diagonal, out_off_diagonal, out_opacities, out_lambdas}, stream);
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

gsb::cuda::RefineArgs refine_args(int64_t N, int features_width, const std::vector<int>& widths, Address features,
                                  Address weight_in, Address bias_in, Address weight_out, Address bias_out) {
    using namespace gsb::cuda;
    if (features_width >= MAX_FEATURES || widths.size() > MAX_NETWORKS) throw nb::value_error("networks too large");
    RefineArgs args{N, features_width, static_cast<int>(widths.size()), 0, {}, features, weight_in, bias_in, weight_out,
                    bias_out};
    for (size_t k = 0; k < widths.size(); ++k) {
        if (widths[k] > MAX_WIDTH) throw nb::value_error("networks too large");
        args.outputs += args.widths[k] = widths[k];
    }
    return args;
}

void refine(int64_t N, int features_width, const std::vector<int>& widths, Address features, Address weight_in,
            Address bias_in, Address weight_out, Address bias_out, Address out, Address stream) {
    gsb::cuda::refine(refine_args(N, features_width, widths, features, weight_in, bias_in, weight_out, bias_out), out,
                      stream);
}

void refine_backward(int64_t N, int features_width, const std::vector<int>& widths, Address features, Address weight_in,
                     Address bias_in, Address weight_out, Address bias_out, Address g_out, Address out_features,
                     Address out_weight_in, Address out_bias_in, Address out_weight_out, Address out_bias_out,
                     Address stream) {
    gsb::cuda::refine_backward(
        refine_args(N, features_width, widths, features, weight_in, bias_in, weight_out, bias_out), g_out,
        {out_features, out_weight_in, out_bias_in, out_weight_out, out_bias_out}, stream);
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
