// A tile of 16 x 16 pixels as sixteen blocks of 4 x 4, one SIMD vector each, so that small Gaussians waste few lanes.
#pragma once

#include "../math/blending.h"
#include "bins.h"
#include "simd.h"

namespace gsb {
inline namespace GSB_ISA {

constexpr int BLOCKS = 16, BLOCK = 4;
constexpr int TILE_PIXELS = TILE * TILE;
constexpr int BATCH = 64;     // splats whose blocks are found at once

// The column and row of a lane in its block, and of a block in its tile.
alignas(64) constexpr float COLUMN[LANES] = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
alignas(64) constexpr float ROW[LANES] = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};

// A projected Gaussian (splat) in the form that blending reads: one cache line.
struct alignas(64) Record {
    float x, y, p, q, r, opacity;
    float color[3];        // where there are three channels
    float reach;           // alpha < 1/255 where power is greater
    float foot_x, foot_y;  // see least_power
    int32_t first_pair;    // of its pairs (its tiles by rows) in the order of splats
    int32_t tile_x, tile_y, columns;

    int32_t pair(int tx, int ty) const { return first_pair + (ty - tile_y) * columns + (tx - tile_x); }
};

// The record of a splat with this profile; a shape does not fit into the cache line.
template <class Profile>
struct RecordOf : Record {};
template <>
struct RecordOf<Beta> : Record {
    float shape;
};
static_assert(sizeof(RecordOf<Gaussian>) == 64);

template <class Profile>
RecordOf<Profile> make_record(const BlendArgs& a, int64_t camera, int64_t i, const TileRect& rect) {
    const int64_t at = camera * a.N + i;
    const float *mean = a.means2d + at * 2, *root = a.roots + at * 4;
    RecordOf<Profile> s{};
    s.x = mean[0];
    s.y = mean[1];
    s.p = root[0];
    s.q = root[1];
    s.r = root[2];
    s.opacity = root[3];
    const float reach = a.half_sizes[at * 2] * s.p;
    s.reach = reach * reach;
    s.foot_y = -s.q / s.r;
    s.foot_x = -s.q * s.r / (s.p * s.p + s.q * s.q);
    s.tile_x = rect.x0;
    s.tile_y = rect.y0;
    s.columns = rect.x1 - rect.x0;
    if (a.D == 3) {
        const float* color = a.colors + (a.color_per_camera ? at : i) * 3;
        for (int k = 0; k < 3; ++k) s.color[k] = color[k];
    }
    if constexpr (Profile::HAS_SHAPE) s.shape = a.shapes[a.shape_per_camera ? at : i];
    return s;
}

// Makes the records of a camera's splats that touch tiles, without first_pair (see `number_pairs`). `pairs` [N] gets
// the number of tiles of each splat; it may be null.
template <class Profile>
void make_records(const BlendArgs& a, int64_t camera, RecordOf<Profile>* records, int32_t* pairs) {
    const int64_t base = camera * a.N;
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N > 1024)
    for (int64_t first = 0; first < a.N; first += LANES) {
        const int n = lanes_from(first, a.N);
        TileRect rects[LANES];
        tile_rects(a.means2d + base * 2, a.half_sizes + base * 2, first, n, a.width, a.height, rects);
        for (int k = 0; k < n; ++k) {
            if (pairs) pairs[first + k] = static_cast<int32_t>(rects[k].count());
            if (rects[k].count() > 0) records[first + k] = make_record<Profile>(a, camera, first + k, rects[k]);
        }
    }
}

// Sets first_pair of each splat, so that the tile intersections (pairs) of all splats are numbered consecutively.
// `pairs` [N + 1] holds the number of pairs of each splat on entry, and the number of its first pair afterwards.
template <class Profile>
void number_pairs(const BlendArgs& a, RecordOf<Profile>* records, int32_t* pairs) {
    int32_t total = 0;
    for (int64_t i = 0; i < a.N; ++i) {
        const int32_t count = pairs[i];
        if (count) records[i].first_pair = total;
        pairs[i] = total;
        total += count;
    }
    pairs[a.N] = total;
}

// The positions of the pixels and blocks of one tile.
struct TileGrid {
    int left, top, width, height;        // of the tile; of the part of it that is in the picture
    Vec lane_x[4], lane_y[4];            // pixel centres of the block columns and rows
    Vec block_x, block_y;                // first pixel centres of the sixteen blocks
    alignas(64) int32_t places[LANES];   // a block's pixels, counted from its first in the picture

    TileGrid(int tx, int ty, int picture_width, int picture_height) : left(tx * TILE), top(ty * TILE) {
        width = picture_width - left < TILE ? picture_width - left : TILE;
        height = picture_height - top < TILE ? picture_height - top : TILE;
        const Vec column = Vec::load(COLUMN), row = Vec::load(ROW);
        for (int b = 0; b < 4; ++b) {
            lane_x[b] = column + (static_cast<float>(left + b * BLOCK) + 0.5f);
            lane_y[b] = row + (static_cast<float>(top + b * BLOCK) + 0.5f);
        }
        block_x = column * BLOCK + (static_cast<float>(left) + 0.5f);
        block_y = row * BLOCK + (static_cast<float>(top) + 0.5f);
        for (int i = 0; i < LANES; ++i) places[i] = i / BLOCK * picture_width + i % BLOCK;
    }

    // Returns the index of a block's first pixel in the image, and a mask of its pixels that are inside the image.
    int64_t first_pixel(int b, int64_t camera, int picture_width, int picture_height) const {
        return (camera * picture_height + top + (b >> 2) * BLOCK) * picture_width + left + (b & 3) * BLOCK;
    }
    uint32_t inside(int b) const {
        const Vec right(static_cast<float>(left + width)), bottom(static_cast<float>(top + height));
        return bits((lane_x[b & 3] < right) & (lane_y[b >> 2] < bottom));
    }

    // Returns a mask of the blocks that have a pixel which the splat may reach.
    GSB_HD uint32_t touched(const Record& s) const {
        const Vec x0 = block_x - s.x, y0 = block_y - s.y;
        const Vec power = least_power<Vec>(x0, x0 + (BLOCK - 1), y0, y0 + (BLOCK - 1), s.p, s.q, s.r, s.foot_x, s.foot_y);
        return bits(power <= Vec(s.reach));
    }
};

}  // namespace GSB_ISA
}  // namespace gsb
