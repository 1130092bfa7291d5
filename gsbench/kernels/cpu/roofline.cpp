// Measures the peak performance of one thread on this machine, with the same SIMD vectors that the kernels use.
#include "../math/blending.h"

#include "isa.h"
#include "simd.h"

namespace gsb {
inline namespace GSB_ISA {

// Runs `rounds` rounds of ten independent vector multiply-adds: 20 * LANES * rounds floating-point operations.
float roofline_flops(int64_t rounds) {
    constexpr int CHAINS = 10;  // two a cycle of four cycles' latency need eight
    Vec sums[CHAINS];
    for (int k = 0; k < CHAINS; ++k) sums[k] = Vec(0.1f * static_cast<float>(k));
    const Vec scale(0.999f), step(0.001f);
    for (int64_t i = 0; i < rounds; ++i) {
        GSB_UNROLL for (int k = 0; k < CHAINS; ++k) sums[k] = sums[k] * scale + step;
    }
    Vec total(0.0f);
    for (const auto& one : sums) total += one;
    return sum(total);
}

// Computes a = b + s c, which moves 12 bytes per element to and from memory.
void roofline_triad(float* a, const float* b, const float* c, int64_t n) {
    for (int64_t i = 0; i + LANES <= n; i += LANES) (Vec::load(b + i) + Vec::load(c + i) * 0.5f).store(a + i);
}

// Runs the inner loop of blending in registers: LANES * rounds alphas, each blended into three channels.
float roofline_alphas(int64_t rounds) {
    constexpr int CHAINS = 4;
    constexpr struct {
        float p = 0.6f, q = 0.1f, r = 0.5f, opacity = 0.01f;
    } splat;
    Vec T[CHAINS], color[CHAINS][3], x = Vec(0.3f);
    for (int k = 0; k < CHAINS; ++k) {
        T[k] = Vec(1.0f);
        for (auto& channel : color[k]) channel = Vec(0.0f);
    }
    for (int64_t i = 0; i < rounds / CHAINS; ++i) {
        GSB_UNROLL for (int k = 0; k < CHAINS; ++k) {
            const Falloff<Vec> f(x + static_cast<float>(k), x, splat);
            const Vec after = T[k] - T[k] * f.alpha;
            const Mask blended = (f.alpha >= Vec(ALPHA_MIN)) & (after >= Vec(TRANSMITTANCE_MIN));
            const Vec weight = select(blended, T[k] * f.alpha, Vec(0.0f));
            for (auto& channel : color[k]) channel += weight * x;
            T[k] = select(blended, after, T[k]);
        }
        x = x * Vec(0.9999f);
    }
    Vec total(0.0f);
    for (const auto& chain : color) total += chain[0] + chain[1] + chain[2];
    return sum(total);
}

}  // namespace GSB_ISA
}  // namespace gsb
