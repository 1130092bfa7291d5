// Blending splats into pictures, front to back, tile by tile.
#include "buffer.h"
#include "isa.h"
#include "tile.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

struct TileJob {
    const BlendArgs& args;
    const Picture& out;
    const Record* records;
    const float* colors;  // of the camera, where there are not three channels
    int64_t tile;         // of all cameras' tiles
    int64_t camera;
    int tx, ty;
    float* color;  // scratch, [D][256]
};

// The tile's colours over the background, from planes in the order of blocks to the rows of the picture.
template <int D>
void write_picture(const TileJob& job, const TileGrid& grid) {
    const BlendArgs& a = job.args;
    const int channels = D ? D : a.D;
    float* T = job.out.transmittance + job.tile * TILE_PIXELS;
    alignas(64) float alpha[TILE_PIXELS];
    for (int at = 0; at < TILE_PIXELS; at += LANES) {
        const Vec signed_left = Vec::load(T + at), left = max(signed_left, -signed_left);
        left.store(T + at);
        (Vec(1.0f) - left).store(alpha + at);
        for (int k = 0; k < channels; ++k) {
            float* color = job.color + k * TILE_PIXELS + at;
            (Vec::load(color) + left * a.background[k]).store(color);
        }
    }
    each_row(grid, [&](int at, int x, int y, int n) {
        const int64_t pixel = (job.camera * a.height + y) * a.width + x;
        float* image = job.out.image + pixel * channels;
        if (D && n == BLOCK) {  // the same as below, unrolled
            for (int i = 0; i < BLOCK; ++i) {
                job.out.alpha[pixel + i] = alpha[at + i];
                for (int k = 0; k < D; ++k) image[i * D + k] = job.color[k * TILE_PIXELS + at + i];
            }
            return;
        }
        for (int i = 0; i < n; ++i) {
            job.out.alpha[pixel + i] = alpha[at + i];
            for (int k = 0; k < channels; ++k) image[i * channels + k] = job.color[k * TILE_PIXELS + at + i];
        }
    });
}

// One splat, the i-th of its tile, over one block. False: no pixel of the block is left to blend.
template <int D>
GSB_HD inline bool blend_block(const TileJob& job, const TileGrid& grid, int64_t i, int32_t id, int b, float* T,
                               float* stop) {
    const Record& s = job.records[id];
    const int channels = D ? D : job.args.D, at = b * LANES;
    const float* c = D == 3 ? s.color : job.colors + static_cast<int64_t>(id) * channels;
    const Vec zero(0.0f);
    const Falloff<Vec> f(grid.lane_x[b & 3] - s.x, grid.lane_y[b >> 2] - s.y, s.p, s.q, s.r, s.opacity);
    const Vec before = Vec::load(T + at), after = before - before * f.alpha;
    const Mask seen = f.alpha >= Vec(ALPHA_MIN), enough = after >= Vec(TRANSMITTANCE_MIN);
    const Mask blended = seen & enough;
    const Vec weight = select(blended, before * f.alpha, zero);
    for (int k = 0; k < channels; ++k) {
        float* sums = job.color + k * TILE_PIXELS + at;
        (Vec::load(sums) + weight * c[k]).store(sums);
    }
    const Vec left = select(blended, after, before);
    const Mask ends = seen & !enough & (before > zero);
    if (!any(ends)) {
        left.store(T + at);
        return true;
    }
    const Vec marked = select(ends, -before, left);
    marked.store(T + at);
    select(ends, Vec(static_cast<float>(i)), Vec::load(stop + at)).store(stop + at);
    return any(marked > zero);
}

// D channels, 0: as many as the arguments say. A pixel that is done, or outside, has transmittance <= 0.
template <int D>
void blend_tile(const TileJob& job) {
    const BlendArgs& a = job.args;
    const int channels = D ? D : a.D;
    const TileGrid grid(job.tx, job.ty, a.width, a.height);
    const int32_t* ids = a.ids + a.offsets[job.tile];
    const int64_t count = a.offsets[job.tile + 1] - a.offsets[job.tile];
    float *T = job.out.transmittance + job.tile * TILE_PIXELS, *stop = job.out.stop + job.tile * TILE_PIXELS;
    float* color = job.color;
    for (int k = 0; k < channels * TILE_PIXELS; ++k) color[k] = 0.0f;
    const Vec right(static_cast<float>(a.width)), bottom(static_cast<float>(a.height)), zero(0.0f);
    uint32_t alive = 0;
    for (int b = 0; b < BLOCKS; ++b) {
        const Mask inside = (grid.lane_x[b & 3] < right) & (grid.lane_y[b >> 2] < bottom);
        select(inside, Vec(1.0f), zero).store(T + b * LANES);
        Vec(static_cast<float>(count)).store(stop + b * LANES);
        alive |= static_cast<uint32_t>(any(inside)) << b;
    }

    // Which blocks a splat touches is found for many splats at once, before any is blended: the loop over a list of
    // (splat, block) has no branch to mispredict.
    int32_t work[BATCH * BLOCKS + LANES];
    for (int64_t first = 0; first < count && alive; first += BATCH) {
        const int64_t end = first + BATCH < count ? first + BATCH : count;
        int items = 0;
        for (int64_t i = first; i < end; ++i) {
            __builtin_prefetch(job.records + ids[i + AHEAD < count ? i + AHEAD : i]);
            items += append_bits(grid.touched(job.records[ids[i]]) & alive, static_cast<int32_t>(i - first) * BLOCKS,
                                 work + items);
        }
        for (int item = 0; item < items; ++item) {
            const int64_t i = first + work[item] / BLOCKS;
            const int b = work[item] % BLOCKS;
            if (!blend_block<D>(job, grid, i, ids[i], b, T, stop)) alive &= ~(1u << b);
        }
    }
    write_picture<D>(job, grid);
}

}  // namespace

void blend(const BlendArgs& a, const Picture& out) {
    const int across = tiles_along(a.width), tiles = across * tiles_along(a.height);
    Buffer<Record> records(static_cast<size_t>(a.N));
    const size_t scratch_size = static_cast<size_t>(a.D) * TILE_PIXELS;
    Buffer<float> scratch(scratch_size * static_cast<size_t>(a.threads));
    for (int64_t c = 0; c < a.C; ++c) {
        make_records(a, c, records.data());
        const float* colors = a.colors + (a.color_per_camera ? c * a.N * a.D : 0);
#pragma omp parallel for num_threads(a.threads) schedule(dynamic, 4)
        for (int tile = 0; tile < tiles; ++tile) {
            const TileJob job{a, out, records.data(), colors, c * tiles + tile, c, tile % across, tile / across,
                              scratch.data() + scratch_size * static_cast<size_t>(thread_index())};
            a.D == 3 ? blend_tile<3>(job) : blend_tile<0>(job);
        }
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
