// The rectangle of tiles that a splat can touch: binning and blending must agree on it to the last tile.
#pragma once

#include <cmath>
#include <cstdint>

#include "../math/scalar.h"
#include "kernels.h"

namespace gsb {
inline namespace GSB_ISA {

struct TileRect {
    int x0, y0, x1, y1;  // half open; empty where x1 <= x0

    int64_t count() const { return static_cast<int64_t>(x1 - x0) * (y1 - y0); }
};

// The tiles from the first pixel centre at or after low to the last at or before high; bounded as floats, since the
// bounds of a huge splat overflow integers.
inline void tile_span(float low, float high, int pixels, int& begin, int& end) {
    const float first = max(std::ceil(low - 0.5f), 0.0f);
    const float last = min(std::floor(high - 0.5f), static_cast<float>(pixels - 1));
    if (!(first <= last)) {
        begin = end = 0;
        return;
    }
    begin = static_cast<int>(first) / TILE;
    end = static_cast<int>(last) / TILE + 1;
}

inline TileRect tile_rect(const float* mean2d, const float* half_size, int width, int height) {
    TileRect r{0, 0, 0, 0};
    if (half_size[0] > 0.0f) {
        tile_span(mean2d[0] - half_size[0], mean2d[0] + half_size[0], width, r.x0, r.x1);
        tile_span(mean2d[1] - half_size[1], mean2d[1] + half_size[1], height, r.y0, r.y1);
    }
    return r;
}

}  // namespace GSB_ISA
}  // namespace gsb
