// Lists the projected Gaussians (splats) of each tile, front to back: sorts them by depth, lists the tiles that each
// one reaches, and sorts these intersections stably by tile. A warp processes one splat, and its lanes the tiles in its
// bounds.
#include "patch.h"
#include "sort.h"

#include <algorithm>
#include <limits>

namespace gsb::cuda {
namespace {

// Cuts arrays from scratch memory. What is cut from the address 0 only counts bytes.
class Memory {
public:
    explicit Memory(void* start) : start(reinterpret_cast<uintptr_t>(start)) {}

    template <class T>
    T* take(int64_t n) {
        T* const array = reinterpret_cast<T*>(start + used);
        used += (static_cast<size_t>(n) * sizeof(T) + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT;
        return array;
    }

    size_t bytes() const { return used; }

private:
    static constexpr size_t ALIGNMENT = 256;
    uintptr_t start;
    size_t used = 0;
};

struct Scratch {
    Memory memory;
    uint32_t *keys, *indices, *sorted_keys;  // [C * N]
    uint32_t* order;                         // [C * N] splats by depth
    int64_t* ends;                           // [C * N] the running sum of the tiles that they touch, in this order
    uint32_t *tiles, *splats, *sorted_tiles;  // [room] of each intersection; tiles may have 16 bits
    void* sort;                               // the rest, which sorts and sums need

    Scratch(void* start, int64_t count, int64_t room) : memory(start) {
        for (uint32_t** array : {&keys, &indices, &sorted_keys, &order}) *array = memory.take<uint32_t>(count);
        ends = memory.take<int64_t>(count);
        for (uint32_t** array : {&tiles, &splats, &sorted_tiles}) *array = memory.take<uint32_t>(room);
        sort = memory.take<char>(0);
    }
};

__global__ void key_kernel(BlendArgs a, const float* depths, uint32_t* keys, uint32_t* indices) {
    const int64_t s = global_thread();
    if (s >= a.N * a.C) return;
    // Positive floats have the same order as their bits.
    keys[s] = a.half_sizes[s * 2] > 0.0f ? __float_as_uint(depths[s]) : 0xffffffffu;
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
__device__ void each_tile(const BlendArgs& a, int64_t s, Visit visit) {
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
__global__ void count_kernel(BlendArgs a, const uint32_t* order, int64_t* counts) {
    const int64_t k = global_thread() / WARP;
    if (k >= a.N * a.C) return;
    int64_t count = 0;
    each_tile<Profile>(a, order[k], [&](bool, int, unsigned reached) { count += __popc(reached); });
    if (threadIdx.x % WARP == 0) counts[k] = count;
}

// Intersections for which there is no memory are left out.
template <class Profile, class Tile>
__global__ void fill_kernel(BlendArgs a, Scratch in, int64_t room, int64_t no_tile, Tile* tiles) {
    const int64_t k = global_thread() / WARP;
    if (k >= a.N * a.C) return;
    const unsigned lane = threadIdx.x % WARP;
    const int64_t all = in.ends[k], end = all < room ? all : room, s = in.order[k];
    int64_t at = k > 0 ? in.ends[k - 1] : 0;
    const int64_t first_tile = s / a.N * tiles_along(a.width) * tiles_along(a.height);
    each_tile<Profile>(a, s, [&](bool reached, int tile, unsigned others) {
        const int64_t mine = at + __popc(others & ((1u << lane) - 1));
        if (reached && mine < end) {
            tiles[mine] = static_cast<Tile>(first_tile + tile);
            in.splats[mine] = static_cast<uint32_t>(s);
        }
        at += __popc(others);
    });
    // The same test, compiled twice, may round differently. An intersection that was counted and is not found here gets
    // no tile.
    for (int64_t rest = at + lane; rest < end; rest += WARP) {
        tiles[rest] = static_cast<Tile>(no_tile);
        in.splats[rest] = static_cast<uint32_t>(s);
    }
}

// Finds where the list of each tile begins in the sorted intersections, and stores their number.
template <class Tile>
__global__ void offset_kernel(const Tile* tiles, const int64_t* total, int64_t count, TileLists out) {
    const int64_t k = global_thread();
    if (k > out.room) return;
    if (k == 0 && total) out.needed[0] = *total;
    const int64_t before = k > 0 ? int64_t{tiles[k - 1]} : -1, here = k < out.room ? int64_t{tiles[k]} : count;
    for (int64_t t = before + 1; t <= here && t <= count; ++t) out.offsets[t] = static_cast<int32_t>(k);
}

int bit_width(int64_t x) {
    int bits = 0;
    for (; x > 0; x >>= 1) ++bits;
    return bits;
}

void sort_by_depth(const BlendArgs& a, const float* depths, const Scratch& in, size_t bytes, Stream stream) {
    const int64_t splats = a.N * a.C;
    launch(key_kernel, blocks_for(splats), THREADS, stream, a, depths, in.keys, in.indices);
    sort_pairs(in.sort, bytes, in.keys, in.sorted_keys, in.indices, in.order, splats, 32, stream);
    launch(a.shapes ? count_kernel<Beta> : count_kernel<Gaussian>, blocks_for(splats * WARP), THREADS, stream, a,
           in.order, in.ends);
    running_sum(in.sort, bytes, in.ends, splats, stream);
}

template <class Tile>
void sort_by_tile(const BlendArgs& a, const Scratch& in, size_t bytes, const TileLists& out, Stream stream) {
    const int64_t count = tiles_of(a), splats = a.N * a.C;
    Tile *tiles = reinterpret_cast<Tile*>(in.tiles), *sorted = reinterpret_cast<Tile*>(in.sorted_tiles);
    if (out.room > 0) {
        fill_bytes(tiles, 0xff, static_cast<size_t>(out.room) * sizeof(Tile), stream);  // what stays so is sorted last
        if (splats > 0) {
            launch(a.shapes ? fill_kernel<Beta, Tile> : fill_kernel<Gaussian, Tile>, blocks_for(splats * WARP), THREADS,
                   stream, a, in, out.room, count, tiles);
        }
        sort_pairs(in.sort, bytes, tiles, sorted, in.splats, reinterpret_cast<uint32_t*>(out.ids), out.room,
                   bit_width(count), stream);
    }
    launch(offset_kernel<Tile>, blocks_for(out.room + 1), THREADS, stream, sorted,
           splats > 0 ? in.ends + splats - 1 : nullptr, count, out);
}

}  // namespace

size_t draw_scratch(int64_t splats, int64_t room) {
    return Scratch(nullptr, splats, room).memory.bytes() + sort_scratch(std::max(splats, room));
}

void list_tiles(const BlendArgs& a, const float* depths, const TileLists& out, Stream stream) {
    const Scratch in(out.scratch, a.N * a.C, out.room);
    const size_t bytes = out.scratch_bytes - in.memory.bytes();
    if (a.N * a.C > 0) sort_by_depth(a, depths, in, bytes, stream);
    // Tiles are numbered from 0, and the number after the last one stands for none.
    const bool is_short = tiles_of(a) <= std::numeric_limits<uint16_t>::max();
    (is_short ? sort_by_tile<uint16_t> : sort_by_tile<uint32_t>)(a, in, bytes, out, stream);
}

}  // namespace gsb::cuda
