// Lists the projected Gaussians (splats) of each tile, front to back: sorts them by depth, lists the tiles that each
// one reaches, and sorts these intersections stably by tile. A warp processes one splat, and its lanes the tiles in its
// bounds.
#include "launch.h"
#include "reach.h"
#include "sort.h"

namespace gsb::cuda {
namespace {

__global__ void key_kernel(BinArgs a, uint32_t* keys, uint32_t* indices) {
    const int64_t s = global_thread();
    if (s >= a.N * a.C) return;
    // Positive floats have the same order as their bits.
    keys[s] = a.half_sizes[s * 2] > 0.0f ? __float_as_uint(a.depths[s]) : 0xffffffffu;
    indices[s] = static_cast<uint32_t>(s);
}

struct Span {
    int begin, end;
};

// Returns the tiles from the first pixel centre at or after `low` to the last one at or before `high`. They are clamped
// as floats, because the bounds of a huge splat overflow integers.
__device__ Span tile_span(float low, float high, int pixels) {
    const float first = max(ceilf(low - 0.5f), 0.0f);
    const float last = min(floorf(high - 0.5f), static_cast<float>(pixels - 1));
    if (!(first <= last)) return {0, 0};
    return {static_cast<int>(first) / TILE, static_cast<int>(last) / TILE + 1};
}

// Calls visit(whether the lane's tile is reached, the tile's index, the mask of lanes that reach theirs) for 32 tiles
// at a time, in all lanes of a warp.
template <class Profile, class Visit>
__device__ void each_tile(const BinArgs& a, int64_t s, Visit visit) {
    const float2 half = reinterpret_cast<const float2*>(a.half_sizes)[s];
    if (!(half.x > 0.0f)) return;
    const float2 mean = reinterpret_cast<const float2*>(a.means2d)[s];
    const Reach reach = reach_of<Profile>(mean, reinterpret_cast<const float4*>(a.roots)[s], a.half_sizes + s * 2);
    const Span columns = tile_span(mean.x - half.x, mean.x + half.x, a.width);
    const Span rows = tile_span(mean.y - half.y, mean.y + half.y, a.height);
    const int across = columns.end - columns.begin, count = across * (rows.end - rows.begin);
    for (int first = 0; first < count; first += WARP) {
        const int nth = first + static_cast<int>(threadIdx.x) % WARP;
        const int x = columns.begin + nth % across, y = rows.begin + nth / across;
        const bool reached = nth < count && reach.touches(x * TILE, y * TILE, TILE, TILE);
        visit(reached, y * tiles_along(a.width) + x, __ballot_sync(ALL_LANES, reached));
    }
}

template <class Profile>
__global__ void count_kernel(BinArgs a, const uint32_t* order, int64_t* counts) {
    const int64_t k = global_thread() / WARP;
    if (k >= a.N * a.C) return;
    int64_t count = 0;
    each_tile<Profile>(a, order[k], [&](bool, int, unsigned reached) { count += __popc(reached); });
    if (threadIdx.x % WARP == 0) counts[k] = count;
}

// Intersections for which there is no memory are left out.
template <class Profile>
__global__ void fill_kernel(BinArgs a, TileOrder by_depth, int64_t no_tile, uint32_t* tiles, uint32_t* splats) {
    const int64_t k = global_thread() / WARP;
    if (k >= a.N * a.C) return;
    const unsigned lane = threadIdx.x % WARP;
    const int64_t all = by_depth.ends[k], end = all < by_depth.pairs ? all : by_depth.pairs, s = by_depth.order[k];
    int64_t at = k > 0 ? by_depth.ends[k - 1] : 0;
    const int64_t first_tile = s / a.N * tiles_along(a.width) * tiles_along(a.height);
    each_tile<Profile>(a, s, [&](bool reached, int tile, unsigned others) {
        const int64_t mine = at + __popc(others & ((1u << lane) - 1));
        if (reached && mine < end) {
            tiles[mine] = static_cast<uint32_t>(first_tile + tile);
            splats[mine] = static_cast<uint32_t>(s);
        }
        at += __popc(others);
    });
    // The same test, compiled twice, may round differently. An intersection that was counted and is not found here gets
    // no tile.
    for (int64_t rest = at + lane; rest < end; rest += WARP) {
        tiles[rest] = static_cast<uint32_t>(no_tile);
        splats[rest] = static_cast<uint32_t>(s);
    }
}

// Tile t's list is [offsets[t], offsets[t + 1]) of the sorted intersections.
__global__ void offset_kernel(const uint32_t* tiles, int64_t pairs, int64_t count, int32_t* offsets) {
    const int64_t k = global_thread();
    if (k > pairs) return;
    const int64_t before = k > 0 ? int64_t{tiles[k - 1]} : -1, here = k < pairs ? int64_t{tiles[k]} : count;
    for (int64_t t = before + 1; t <= here && t <= count; ++t) offsets[t] = static_cast<int32_t>(k);
}

int bit_width(int64_t x) {
    int bits = 0;
    for (; x > 0; x >>= 1) ++bits;
    return bits;
}

}  // namespace

void count_tiles(const BinArgs& a, const TileCounts& out, Stream stream) {
    if (a.N * a.C == 0) return;
    launch(key_kernel, blocks_for(a.N * a.C), THREADS, stream, a, out.keys, out.indices);
    sort_pairs(out.scratch, out.scratch_bytes, out.keys, out.sorted_keys, out.indices, out.order, a.N * a.C, 32,
               stream);
    launch(a.shapes ? count_kernel<Beta> : count_kernel<Gaussian>, blocks_for(a.N * a.C * WARP), THREADS, stream, a,
           out.order, out.ends);
    running_sum(out.scratch, out.scratch_bytes, out.ends, a.N * a.C, stream);
}

void fill_tiles(const BinArgs& a, const TileOrder& by_depth, const TileLists& out, Stream stream) {
    const int64_t count = a.C * tiles_along(a.width) * tiles_along(a.height), pairs = by_depth.pairs;
    if (pairs > 0) {
        if (a.N * a.C > 0) {
            launch(a.shapes ? fill_kernel<Beta> : fill_kernel<Gaussian>, blocks_for(a.N * a.C * WARP), THREADS, stream,
                   a, by_depth, count, out.tiles, out.splats);
        }
        sort_pairs(out.scratch, out.scratch_bytes, out.tiles, out.sorted_tiles, out.splats, out.ids, pairs,
                   bit_width(count), stream);
    }
    launch(offset_kernel, blocks_for(pairs + 1), THREADS, stream, out.sorted_tiles, pairs, count, out.offsets);
}

}  // namespace gsb::cuda
