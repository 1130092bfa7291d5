// SSIM of two images at one pixel (Wang et al. 2004, eq. 13) from filtered moments, and its derivatives.
#pragma once

#include "../arguments.h"
#include "scalar.h"

namespace gsb {
inline namespace GSB_ISA {

constexpr int SSIM_RADIUS = 5;  // an 11 x 11 window of standard deviation 1.5, as 3DGS trains with
constexpr int SSIM_WINDOW = 2 * SSIM_RADIUS + 1;
constexpr double SSIM_SIGMA = 1.5;

// Returns x / 255 for a whole x from 0 to 255, with the bits of a division, which takes longer. The first product is
// exact, because its factor has few bits; the second one adds the rest of 1 / 255.
template <class T>
GSB_HD constexpr T over_255(T x) {
    constexpr double high = 257.0 / 65536.0;
    return x * static_cast<float>(high) + x * static_cast<float>(1.0 / 255.0 - high);
}

constexpr bool divides_every_byte() {
    for (int i = 0; i < 256; ++i) {
        if (over_255(static_cast<float>(i)) != static_cast<float>(i) / 255.0f) return false;
    }
    return true;
}
static_assert(divides_every_byte());

template <class T>
struct Similarity {
    T value;
    T g_mean, g_square, g_product;  // its derivatives by the filtered a, a^2 and a b

    // The arguments are the filtered a, b, a^2, b^2 and a b; a is the render and b the ground truth.
    GSB_HD Similarity(T mean_a, T mean_b, T aa, T bb, T ab) {
        constexpr float C1 = 0.01f * 0.01f, C2 = 0.03f * 0.03f;
        const T product = mean_a * mean_b, squares = mean_a * mean_a + mean_b * mean_b;
        const T luminance = product * 2.0f + C1, structure = (ab - product) * 2.0f + C2;
        const T B1 = squares + C1, B2 = aa + bb - squares + C2;
        const T inverse = T(1.0f) / (B1 * B2);
        value = luminance * structure * inverse;
        g_product = luminance * inverse * 2.0f;
        g_square = T(0.0f) - value * inverse * B1;
        g_mean = (mean_b * (structure - luminance) - value * mean_a * (B2 - B1)) * inverse * 2.0f;
    }
};

// Moves arguments for several images from the first image to the c-th one, except the sums of the loss.
GSB_HD inline void begin_at_image(int64_t c, SimilarityArgs& a, SimilarityLoss& out) {
    const int64_t first = c * a.height * a.width * 3;
    a.image += first;
    if (a.target) a.target += first;
    if (a.target_bytes) a.target_bytes += first;
    if (out.gradient) out.gradient += first;
    if (out.scratch) out.scratch += 3 * first;
}

}  // namespace GSB_ISA
}  // namespace gsb
