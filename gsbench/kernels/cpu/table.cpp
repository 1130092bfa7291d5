// The table of kernels of one instruction set; dispatch.cpp chooses one of these tables.
#include "isa.h"

#define GSB_TEXT_(x) #x
#define GSB_TEXT(x) GSB_TEXT_(x)

namespace gsb {
inline namespace GSB_ISA {

extern const Kernels table;
#define GSB_ENTRY(name, ...) name,
const Kernels table{GSB_TEXT(GSB_ISA), GSB_CPU_KERNELS(GSB_ENTRY) roofline_flops, roofline_triad, roofline_alphas};

}  // namespace GSB_ISA
}  // namespace gsb
