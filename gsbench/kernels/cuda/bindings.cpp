// The Python extension of the CUDA kernels.
#include "../bindings.h"

#include "kernels.h"

NB_MODULE(GSB_MODULE, m) {
    m.attr("SIGNATURES") = nanobind::dict();
    using namespace gsb;
#define GSB_DEFINE(name, ...)                                                                           \
    bindings::define<__VA_ARGS__>(m, #name, [](const auto&... arguments) { cuda::name(arguments...); }, \
                                  cuda::Stream{});
    GSB_CUDA_KERNELS(GSB_DEFINE)
    m.def("draw_scratch", &cuda::draw_scratch, "Bytes of scratch memory for so many splats and tile intersections.");
    m.def("similarity_parts", &cuda::similarity_parts, "Parts that l1_ssim leaves of its loss.");
}
