// Blends projected Gaussians (splats) into images, front to back, tile by tile.
#include "buffer.h"
#include "isa.h"
#include "tile.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

template <class Profile>
struct TileJob {
    const BlendArgs& args;
    const Picture& out;
    const RecordOf<Profile>* records;
    const float* colors;  // of the camera, where there are not three channels
    int64_t tile;         // of all cameras' tiles
    int64_t camera;
    int tx, ty;
    float* state;  // scratch, see Blocks
};

// The state of a tile's pixels: for each block the transmittance and D sums of colour, placed so that no two of them
// are a multiple of 4 kB apart. A pixel that has ended or is outside of the image has transmittance <= 0.
struct Blocks {
    float* state;
    int channels;

    float* transmittance(int b) const { return state + b * (1 + channels) * LANES; }
    float* color(int b) const { return transmittance(b) + LANES; }
    static size_t size(int channels) { return static_cast<size_t>(1 + channels) * TILE_PIXELS; }
};

// Blends one splat, the i-th of its tile, into one block.
template <int D, class Profile>
GSB_HD inline void blend_block(const RecordOf<Profile>& s, const float* color, int channels, const TileGrid& grid,
                               int64_t i, uint32_t b, Blocks blocks, float* stop) {
    const Vec zero(0.0f);
    float *T = blocks.transmittance(static_cast<int>(b)), *sums = blocks.color(static_cast<int>(b));
    const Falloff<Vec, Profile> f(same_rows(grid.lane_x[b & 3] - s.x), grid.lane_y[b >> 2] - s.y, s);
    const Vec before = Vec::load(T), after = before - before * f.alpha;
    const Mask seen = f.alpha >= Vec(ALPHA_MIN), enough = after >= Vec(TRANSMITTANCE_MIN);
    const Mask blended = seen & enough;
    const Vec weight = select(blended, before * f.alpha, zero);
    for (int k = 0; k < (D ? D : channels); ++k) {
        (Vec::load(sums + k * LANES) + weight * color[k]).store(sums + k * LANES);
    }
    select(blended, after, negative_where(seen, before)).store(T);  // seen and not blended: the pixel ends here
    const Mask ends = seen & !enough & (before > zero);
    if (any(ends)) store_where(ends, Vec(static_cast<float>(i)), stop + b * LANES);
}

// Writes the tile's colours over the background to the image, and its state for the backward pass.
template <int D, class Profile>
void write_picture(const TileJob<Profile>& job, const TileGrid& grid, Blocks blocks) {
    const BlendArgs& a = job.args;
    const int channels = D ? D : a.D;
    alignas(64) int32_t places[LANES];
    for (int i = 0; i < LANES; ++i) places[i] = grid.places[i] * channels;
    const Places pixels(grid.places), samples(places);
    for (int b = 0; b < BLOCKS; ++b) {
        const Vec signed_left = Vec::load(blocks.transmittance(b)), left = max(signed_left, -signed_left);
        left.store(job.out.transmittance + job.tile * TILE_PIXELS + b * LANES);
        const uint32_t inside = grid.inside(b);
        if (!inside) continue;
        const int64_t pixel = grid.first_pixel(b, job.camera, a.width, a.height);
        scatter_at(Vec(1.0f) - left, job.out.alpha + pixel, pixels, inside);
        const auto shown = [&](int k) { return Vec::load(blocks.color(b) + k * LANES) + left * a.background[k]; };
        if (D == 3 && inside == ALL_LANES) {
            store_rgb(shown(0), shown(1), shown(2), job.out.image + pixel * 3, static_cast<int64_t>(a.width) * 3);
            continue;
        }
        for (int k = 0; k < channels; ++k) {
            scatter_at(shown(k), job.out.image + pixel * channels + k, samples, inside);
        }
    }
}

// Blends one tile with D channels; D = 0 means the number of channels in the arguments.
template <int D, class Profile>
void blend_tile(const TileJob<Profile>& job) {
    const BlendArgs& a = job.args;
    const int channels = D ? D : a.D;
    const TileGrid grid(job.tx, job.ty, a.width, a.height);
    const Blocks blocks{job.state, channels};
    const RecordOf<Profile>* records = job.records;
    const float* colors = job.colors;
    const int32_t* ids = a.ids + a.offsets[job.tile];
    const int64_t count = a.offsets[job.tile + 1] - a.offsets[job.tile];
    float* stop = job.out.stop + job.tile * TILE_PIXELS;
    __builtin_memset(job.state, 0, Blocks::size(channels) * sizeof(float));
    uint32_t alive = 0;
    for (int b = 0; b < BLOCKS; ++b) {
        const Mask inside = (grid.lane_x[b & 3] < Vec(static_cast<float>(a.width))) &
                            (grid.lane_y[b >> 2] < Vec(static_cast<float>(a.height)));
        select(inside, Vec(1.0f), Vec(0.0f)).store(blocks.transmittance(b));
        Vec(static_cast<float>(count)).store(stop + b * LANES);
        alive |= static_cast<uint32_t>(any(inside)) << b;
    }

    // The blocks that a splat touches are computed for many splats before any is blended. So the loop over (splat,
    // block) has no branches that could be mispredicted.
    uint32_t work[BATCH * BLOCKS + LANES];
    for (int64_t first = 0; first < count && alive; first += BATCH) {
        const int64_t end = first + BATCH < count ? first + BATCH : count;
        int items = 0;
        for (int64_t i = first; i < end; ++i) {
            __builtin_prefetch(records + ids[i + AHEAD < count ? i + AHEAD : i]);
            items += append_bits(grid.touched(records[ids[i]]) & alive, static_cast<uint32_t>(i - first) * BLOCKS,
                                 work + items);
        }
        for (int item = 0; item < items; ++item) {
            const int64_t i = first + work[item] / BLOCKS;
            const uint32_t b = work[item] % BLOCKS;
            const RecordOf<Profile>& s = records[ids[i]];
            const float* color = D == 3 ? s.color : colors + static_cast<int64_t>(ids[i]) * channels;
            blend_block<D>(s, color, channels, grid, i, b, blocks, stop);
        }
        for (uint32_t rest = alive; rest; rest &= rest - 1) {
            const int b = __builtin_ctz(rest);
            if (!any(Vec::load(blocks.transmittance(b)) > Vec(0.0f))) alive &= ~(1u << b);
        }
    }
    write_picture<D>(job, grid, blocks);
}

template <class Profile>
void blend_as(const BlendArgs& a, const Picture& out) {
    const int across = tiles_along(a.width), tiles = across * tiles_along(a.height);
    Buffer<RecordOf<Profile>> records(static_cast<size_t>(a.N));
    const size_t scratch_size = Blocks::size(a.D);
    Buffer<float> scratch(scratch_size * static_cast<size_t>(a.threads));
    for (int64_t c = 0; c < a.C; ++c) {
        make_records(a, c, records.data(), nullptr);
        const float* colors = a.colors + (a.color_per_camera ? c * a.N * a.D : 0);
#pragma omp parallel for num_threads(a.threads) schedule(dynamic, 4)
        for (int tile = 0; tile < tiles; ++tile) {
            const TileJob<Profile> job{a, out, records.data(), colors, c * tiles + tile, c, tile % across,
                                       tile / across, scratch.data() + scratch_size * static_cast<size_t>(thread_index())};
            a.D == 3 ? blend_tile<3>(job) : blend_tile<0>(job);
        }
    }
}

}  // namespace

void blend(const BlendArgs& a, const Picture& out) {
    a.shapes ? blend_as<Beta>(a, out) : blend_as<Gaussian>(a, out);
}

}  // namespace GSB_ISA
}  // namespace gsb
