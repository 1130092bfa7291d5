// Lists the projected Gaussians (splats) of each tile, front to back: sorts them once by depth, then appends each to
// the lists of its tiles in this order.
#include "bins.h"

#include <cstring>

#include "buffer.h"
#include "isa.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int DIGIT_BITS = 11;
constexpr uint32_t DIGITS = 1u << DIGIT_BITS;

struct Key {
    uint32_t depth;  // the bits of a positive float sort as the float does
    int32_t entry;
};

// A splat that touches tiles. Splats are visited in order of depth, which is random in memory, so the entries are small
// and adjacent.
struct Entry {
    int32_t id;
    uint16_t x0, y0, x1, y1;  // its TileRect: no picture is more than FARTHEST / TILE tiles wide
};
static_assert(FARTHEST / TILE < 65536);

// Stable radix sort by depth, least significant digit first; a digit that is equal in all keys is skipped. Returns the
// address of the result.
Key* radix_sort(Key* keys, Key* spare, int64_t n) {
    for (int shift = 0; shift < 32; shift += DIGIT_BITS) {
        int64_t starts[DIGITS] = {};
        for (int64_t i = 0; i < n; ++i) ++starts[(keys[i].depth >> shift) & (DIGITS - 1)];
        if (n == 0 || starts[(keys[0].depth >> shift) & (DIGITS - 1)] == n) continue;
        int64_t total = 0;
        for (auto& start : starts) {
            const int64_t count = start;
            start = total;
            total += count;
        }
        for (int64_t i = 0; i < n; ++i) spare[starts[(keys[i].depth >> shift) & (DIGITS - 1)]++] = keys[i];
        Key* swap = keys;
        keys = spare;
        spare = swap;
    }
    return keys;
}

// Calls f(i, rect) for each splat of a camera that touches tiles.
template <class F>
void each_rect(const BinArgs& a, int64_t camera, F f) {
    const float *means2d = a.means2d + camera * a.N * 2, *half_sizes = a.half_sizes + camera * a.N * 2;
    for (int64_t i = 0; i < a.N; i += LANES) {
        const int n = lanes_from(i, a.N);
        TileRect rects[LANES];
        tile_rects(means2d, half_sizes, i, n, a.width, a.height, rects);
        for (int k = 0; k < n; ++k) {
            if (rects[k].count() > 0) f(i + k, rects[k]);
        }
    }
}

}  // namespace

void count_tiles(const BinArgs& a, const TileOffsets& out) {
    const int across = tiles_along(a.width), down = tiles_along(a.height);
    const int64_t tiles = static_cast<int64_t>(across) * down;
    Buffer<int64_t> counts(static_cast<size_t>(a.C * tiles));
    // Each splat needs four additions for any size: the differences are written first, and summed along both axes
    // afterwards.
    Buffer<int64_t> corners(static_cast<size_t>(across + 1) * (down + 1));
    for (int64_t c = 0; c < a.C; ++c) {
        corners.zero();
        each_rect(a, c, [&](int64_t, const TileRect& r) {
            ++corners[static_cast<size_t>(r.y0) * (across + 1) + r.x0];
            --corners[static_cast<size_t>(r.y0) * (across + 1) + r.x1];
            --corners[static_cast<size_t>(r.y1) * (across + 1) + r.x0];
            ++corners[static_cast<size_t>(r.y1) * (across + 1) + r.x1];
        });
        for (int y = 0; y < down; ++y) {
            int64_t row = 0;
            for (int x = 0; x < across; ++x) {
                const size_t i = static_cast<size_t>(y) * (across + 1) + x;
                row += corners[i];
                const size_t tile = static_cast<size_t>(c * tiles + static_cast<int64_t>(y) * across + x);
                counts[tile] = row + (y > 0 ? counts[tile - static_cast<size_t>(across)] : 0);
            }
        }
    }
    int64_t pairs = 0;
    for (int64_t t = 0; t <= a.C * tiles; ++t) {
        out.offsets[t] = static_cast<int32_t>(pairs);  // of no use where there are more than fit, which `pairs` tells
        if (t < a.C * tiles) pairs += counts[static_cast<size_t>(t)];
    }
    *out.pairs = pairs;
}

void fill_tiles(const BinArgs& a, const TileLists& lists) {
    const int across = tiles_along(a.width), down = tiles_along(a.height);
    const int64_t tiles = static_cast<int64_t>(across) * down;
    Buffer<Key> keys(static_cast<size_t>(a.N)), spare(static_cast<size_t>(a.N));
    Buffer<Entry> entries(static_cast<size_t>(a.N));
    Buffer<int32_t> cursors(static_cast<size_t>(tiles));
    for (int64_t c = 0; c < a.C; ++c) {
        const int32_t* begin = lists.offsets + c * tiles;
        int64_t n = 0;
        each_rect(a, c, [&](int64_t i, const TileRect& r) {
            const auto tile = [](int x) { return static_cast<uint16_t>(x); };
            entries[static_cast<size_t>(n)] = {static_cast<int32_t>(i), tile(r.x0), tile(r.y0), tile(r.x1), tile(r.y1)};
            std::memcpy(&keys[static_cast<size_t>(n)].depth, a.depths + c * a.N + i, sizeof(float));
            keys[static_cast<size_t>(n)].entry = static_cast<int32_t>(n);
            ++n;
        });
        const Key* sorted = radix_sort(keys.data(), spare.data(), n);
        std::memcpy(cursors.data(), begin, sizeof(int32_t) * static_cast<size_t>(tiles));
        // A task reads all splats but appends them only to its own rows of tiles, so that each list stays in order of
        // depth.
        const int tasks = a.threads < down ? a.threads : down;
#pragma omp parallel for num_threads(a.threads) schedule(static, 1)
        for (int task = 0; task < tasks; ++task) {
            const auto first_row = [&](int t) {  // rows that hold an equal share of the pairs
                const int64_t share = begin[0] + static_cast<int64_t>(begin[tiles] - begin[0]) * t / tasks;
                int y = 0;
                while (y < down && begin[static_cast<int64_t>(y) * across] < share) ++y;
                return t == tasks ? down : y;
            };
            const int low = first_row(task), high = first_row(task + 1);
            for (int64_t k = 0; k < n; ++k) {
                __builtin_prefetch(&entries[static_cast<size_t>(sorted[k + AHEAD < n ? k + AHEAD : k].entry)]);
                const Entry e = entries[static_cast<size_t>(sorted[k].entry)];
                const int y0 = e.y0 > low ? e.y0 : low, y1 = e.y1 < high ? e.y1 : high;
                for (int y = y0; y < y1; ++y) {
                    int32_t* row = &cursors[static_cast<size_t>(y) * across];
                    for (int x = e.x0; x < e.x1; ++x) lists.ids[row[x]++] = e.id;
                }
            }
        }
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
