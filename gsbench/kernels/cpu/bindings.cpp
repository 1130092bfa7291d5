// The Python extension of the CPU kernels.
#include "../bindings.h"

#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "dispatch.h"

namespace nb = nanobind;

namespace {

const gsb::Kernels* active = nullptr;

}  // namespace

NB_MODULE(_native, m) {
    active = &gsb::kernels_of(gsb::instruction_sets().back());
    m.def("instruction_sets", &gsb::instruction_sets, "Those built in that run on this machine, the best last.");
    m.def("use", [](const std::string& isa) { active = &gsb::kernels_of(isa); }, "Switch to an instruction set.");
    m.def("active", [] { return std::string(active->isa); }, "The instruction set in use.");
    m.attr("SIGNATURES") = nb::dict();
#define GSB_DEFINE(name, ...) \
    gsb::bindings::define<__VA_ARGS__>(m, #name, [](const auto&... structures) { active->name(structures...); });
    using namespace gsb;
    GSB_CPU_KERNELS(GSB_DEFINE)
    m.def("roofline_flops", [](int64_t rounds) { return active->roofline_flops(rounds); });
    m.def("roofline_alphas", [](int64_t rounds) { return active->roofline_alphas(rounds); });
    m.def("roofline_triad", [](uintptr_t a, uintptr_t b, uintptr_t c, int64_t n) {
        active->roofline_triad(reinterpret_cast<float*>(a), reinterpret_cast<const float*>(b),
                               reinterpret_cast<const float*>(c), n);
    });
}
