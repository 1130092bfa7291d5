#include "dispatch.h"

#include <stdexcept>

namespace gsb {

namespace v2 {
extern const Kernels table;
}
namespace v3 {
extern const Kernels table;
}
namespace v4 {
extern const Kernels table;
}
namespace portable {
extern const Kernels table;
}

static std::vector<const Kernels*> usable() {
    std::vector<const Kernels*> out;
#if defined(GSB_LEVEL_portable)
    out.push_back(&portable::table);
#endif
#if defined(GSB_LEVEL_v2)
    if (__builtin_cpu_supports("ssse3") && __builtin_cpu_supports("sse4.2")) out.push_back(&v2::table);
#endif
#if defined(GSB_LEVEL_v3)
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) out.push_back(&v3::table);
#endif
#if defined(GSB_LEVEL_v4)
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw") &&
        __builtin_cpu_supports("avx512vl")) {
        out.push_back(&v4::table);
    }
#endif
    if (out.empty()) {
        throw std::runtime_error("this processor runs none of the instruction sets that gsbench was built for: "
                                 "build it here, or for all of them by make setup LEVELS=all");
    }
    return out;
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
