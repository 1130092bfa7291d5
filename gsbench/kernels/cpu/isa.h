// Declares the kernels of one instruction set, in a namespace of its own.
#pragma once

#include "../math/scalar.h"
#include "kernels.h"

namespace gsb {
inline namespace GSB_ISA {

#define GSB_DECLARATION(name, ...) void name(GSB_PARAMETERS(__VA_ARGS__));
GSB_CPU_KERNELS(GSB_DECLARATION)
#undef GSB_DECLARATION
float roofline_flops(int64_t rounds);
void roofline_triad(float* a, const float* b, const float* c, int64_t n);
float roofline_alphas(int64_t rounds);

}  // namespace GSB_ISA
}  // namespace gsb
