// The rectangle of tiles that a projected Gaussian (splat) may touch; the lists of tiles and the blending use the same
// one.
#pragma once

#include <cstdint>

#include "kernels.h"
#include "rows.h"

namespace gsb {
inline namespace GSB_ISA {

constexpr int AHEAD = 16;  // splats that are fetched before they are needed

struct TileRect {
    int x0, y0, x1, y1;  // half open; empty where x1 <= x0

    int64_t count() const { return static_cast<int64_t>(x1 - x0) * (y1 - y0); }
};

constexpr float FARTHEST = 1e6f;  // pixels: what is beyond any picture may be as far as a float counts exactly

GSB_HD inline Vec floor(Vec x) {
    const Vec nearest = round(x);
    return nearest - select(nearest > x, Vec(1.0f), Vec(0.0f));
}

// Computes the half-open range of tiles from the first pixel centre at or after `low` to the last one at or before
// `high`.
GSB_HD inline void tile_span(Vec low, Vec high, int pixels, float* begin, float* end) {
    const Vec bounded_low = clamp(low, Vec(-FARTHEST), Vec(FARTHEST)), bounded_high = clamp(high, Vec(-FARTHEST), Vec(FARTHEST));
    const Vec first = max(-floor(Vec(0.5f) - bounded_low), Vec(0.0f));
    const Vec last = min(floor(bounded_high - 0.5f), Vec(static_cast<float>(pixels - 1)));
    const Mask some = first <= last;
    select(some, floor(first * (1.0f / TILE)), Vec(0.0f)).store(begin);
    select(some, floor(last * (1.0f / TILE)) + 1.0f, Vec(0.0f)).store(end);
}

// Computes the rectangles of the splats i .. i + n - 1. A culled splat has half sizes of zero and no tiles.
inline void tile_rects(const float* means2d, const float* half_sizes, int64_t i, int n, int width, int height,
                       TileRect (&out)[LANES]) {
    Vec mean[2], half[2];
    gather_row(means2d, i, n, mean);
    gather_row(half_sizes, i, n, half);
    const Mask drawn = half[0] > Vec(0.0f);
    alignas(64) float x0[LANES], x1[LANES], y0[LANES], y1[LANES];
    tile_span(select(drawn, mean[0] - half[0], Vec(1.0f)), select(drawn, mean[0] + half[0], Vec(0.0f)), width, x0, x1);
    tile_span(mean[1] - half[1], mean[1] + half[1], height, y0, y1);
    for (int k = 0; k < LANES; ++k) {
        out[k] = {static_cast<int>(x0[k]), static_cast<int>(y0[k]), static_cast<int>(x1[k]), static_cast<int>(y1[k])};
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
