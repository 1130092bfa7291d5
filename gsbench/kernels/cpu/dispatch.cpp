#include "dispatch.h"

#include <stdexcept>

namespace gsb {

#if defined(GSB_X86_LEVELS)
namespace v2 {
extern const Kernels table;
}
namespace v3 {
extern const Kernels table;
}
namespace v4 {
extern const Kernels table;
}
#else
namespace portable {
extern const Kernels table;
}
#endif

static std::vector<const Kernels*> usable() {
#if defined(GSB_X86_LEVELS)
    std::vector<const Kernels*> out;
    if (__builtin_cpu_supports("ssse3") && __builtin_cpu_supports("sse4.2")) out.push_back(&v2::table);
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) out.push_back(&v3::table);
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw") &&
        __builtin_cpu_supports("avx512vl")) {
        out.push_back(&v4::table);
    }
    return out;
#else
    return {&portable::table};
#endif
}

std::vector<std::string> instruction_sets() {
    std::vector<std::string> names;
    for (const Kernels* kernels : usable()) names.emplace_back(kernels->isa);
    return names;
}

const Kernels& kernels_of(const std::string& isa) {
    for (const Kernels* kernels : usable()) {
        if (isa == kernels->isa) return *kernels;
    }
    throw std::invalid_argument("instruction set '" + isa + "' is not built or does not run on this machine");
}

}  // namespace gsb
