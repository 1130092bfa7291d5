// The gradients of blending: each tile back to front, then each projected Gaussian (splat) over its tiles.
//
// The sums of each tile intersection are written to memory of their own, and each splat adds the sums of its
// intersections in order. So the result has the same bits for any number of threads.
#include "buffer.h"
#include "isa.h"
#include "tile.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int64_t SPLATS_PER_TASK = 512;

template <class Profile>
struct TileJob {
    const BlendArgs& args;
    const BlendState& picture;
    const PictureGrads& grads;
    const RecordOf<Profile>* records;
    const float* colors;
    int64_t tile, camera;
    int tx, ty;
    float* state;       // scratch, see Blocks
    float* color_sums;  // scratch, [D][16]
    float* pair_sums;   // [pairs][MOMENTS + D]: moments, then sums of colour
    uint8_t* pair_seen;
    float* background;   // [D] of this tile
};

// The state of a tile's pixels, block by block: the transmittance, the colour seen behind the next splat (as its dot
// product with the image gradient), the position at which blending ended, and the gradient of D channels.
struct Blocks {
    float* state;
    int channels;

    float* transmittance(int b) const { return state + b * (3 + channels) * LANES; }
    float* behind(int b) const { return transmittance(b) + LANES; }
    float* stop(int b) const { return transmittance(b) + 2 * LANES; }
    float* gradient(int b) const { return transmittance(b) + 3 * LANES; }
    static size_t size(int channels) { return static_cast<size_t>(3 + channels) * TILE_PIXELS; }
};

// Loads the state behind all splats, where the background is seen, and computes the background's gradient.
template <int D, class Profile>
void load_state(const TileJob<Profile>& job, const TileGrid& grid, Blocks blocks) {
    const BlendArgs& a = job.args;
    const int channels = D ? D : a.D;
    alignas(64) int32_t places[LANES];
    for (int i = 0; i < LANES; ++i) places[i] = grid.places[i] * channels;
    const Places pixels(grid.places), samples(places);
    for (int k = 0; k < channels; ++k) job.background[k] = 0.0f;
    for (int b = 0; b < BLOCKS; ++b) {
        const uint32_t inside = grid.inside(b);
        const int64_t pixel = grid.first_pixel(b, job.camera, a.width, a.height), at = job.tile * TILE_PIXELS + b * LANES;
        const Vec T = Vec::load(job.picture.transmittance + at);
        T.store(blocks.transmittance(b));
        Vec::load(job.picture.stop + at).store(blocks.stop(b));
        Vec behind = inside && job.grads.alpha ? -gather_at(job.grads.alpha + pixel, pixels, inside) : Vec(0.0f);
        Vec rgb[3];
        const bool whole = D == 3 && inside == ALL_LANES;
        if (whole) load_rgb(job.grads.image + pixel * 3, static_cast<int64_t>(a.width) * 3, rgb);
        for (int k = 0; k < channels; ++k) {
            const Vec g = whole ? rgb[k] : inside ? gather_at(job.grads.image + pixel * channels + k, samples, inside) : Vec(0.0f);
            g.store(blocks.gradient(b) + k * LANES);
            behind += g * a.background[k];
            job.background[k] += sum(g * T);
        }
        behind.store(blocks.behind(b));
    }
}

template <int D, class Profile>
void store_sums(const FalloffMoments<Vec, Profile>& moments, const Vec* color, int channels, float* out) {
    const auto& m = moments.of;
    alignas(64) float sums[8];
    sum4(m[0], m[1], m[2], m[3], out);
    if constexpr (D == 3 && Profile::HAS_SHAPE) {
        sum4(m[4], m[5], m[6], color[0], out + 4);
        sum4(color[1], color[2], color[2], color[2], sums);
        out[8] = sums[0];
        out[9] = sums[1];
    } else if constexpr (D == 3) {
        sum4(m[4], m[5], color[0], color[1], out + 4);
        sum4(color[2], color[2], color[2], color[2], sums);
        out[8] = sums[0];
    } else {
        sum4(m[4], m[5], m[Profile::MOMENTS - 1], m[0], sums);
        for (int k = 4; k < Profile::MOMENTS; ++k) out[k] = sums[k - 4];
        for (int k = 0; k < channels; ++k) out[Profile::MOMENTS + k] = sum(color[k]);
    }
}

// Computes the sums of one splat, the i-th of its tile, over the blocks that it touches, and sets the pixels' state to
// that in front of this splat.
template <int D, class Profile>
GSB_HD inline void backward_splat(const RecordOf<Profile>& s, const float* c, int channels, const TileGrid& grid,
                                  int64_t i, uint32_t touched, Blocks blocks, FalloffMoments<Vec, Profile>& moments,
                                  Vec* color) {
    const Vec position(static_cast<float>(i)), zero(0.0f);
    for (Vec& moment : moments.of) moment = zero;
    for (int k = 0; k < (D ? D : channels); ++k) color[k] = zero;
    for (; touched; touched &= touched - 1) {
        const int b = __builtin_ctz(touched);
        float *T = blocks.transmittance(b), *behind = blocks.behind(b);
        const Falloff<Vec, Profile> f(same_rows(grid.lane_x[b & 3] - s.x), grid.lane_y[b >> 2] - s.y, s);
        const Mask blended = (f.alpha >= Vec(ALPHA_MIN)) & (position < Vec::load(blocks.stop(b)));
        const Vec alpha = select(blended, f.alpha, zero);
        const Vec before = Vec::load(T) / (Vec(1.0f) - alpha);
        const Vec weight = alpha * before;
        before.store(T);
        Vec g(0.0f);  // of the splat's own colour
        for (int k = 0; k < (D ? D : channels); ++k) {
            const Vec g_color = Vec::load(blocks.gradient(b) + k * LANES);
            g += g_color * c[k];
            color[k] += weight * g_color;
        }
        // dC/dalpha = T (c - the colour behind the splat). The colour behind the next nearer splat mixes both by alpha.
        const Vec back = Vec::load(behind), difference = g - back;
        (back + alpha * difference).store(behind);
        moments.add(f, select(f.free <= Vec(ALPHA_MAX), weight * difference, zero));
    }
}

template <int D, class Profile>
void backward_tile(const TileJob<Profile>& job) {
    const BlendArgs& a = job.args;
    const int channels = D ? D : a.D;
    const TileGrid grid(job.tx, job.ty, a.width, a.height);
    const Blocks blocks{job.state, channels};
    const RecordOf<Profile>* records = job.records;
    const int32_t* ids = a.ids + a.offsets[job.tile];
    load_state<D>(job, grid, blocks);
    alignas(64) float block_stop[BLOCKS];
    float last = 0.0f;
    for (int b = 0; b < BLOCKS; ++b) {
        block_stop[b] = 0.0f;
        for (int lane = 0; lane < LANES; ++lane) block_stop[b] = max(block_stop[b], blocks.stop(b)[lane]);
        last = max(last, block_stop[b]);
    }
    const Vec stops = Vec::load(block_stop);
    Vec local[D ? D : 1];
    Vec* color = D ? local : reinterpret_cast<Vec*>(job.color_sums);
    FalloffMoments<Vec, Profile> moments;

    uint32_t touched[BATCH];  // found for many splats at once, so that no branch waits for it
    for (int64_t end = static_cast<int64_t>(last); end > 0; end -= BATCH) {
        const int64_t first = end > BATCH ? end - BATCH : 0;
        for (int64_t i = end - 1; i >= first; --i) {
            __builtin_prefetch(records + ids[i < AHEAD ? 0 : i - AHEAD]);
            touched[i - first] = grid.touched(records[ids[i]]) & bits(Vec(static_cast<float>(i)) < stops);
        }
        for (int64_t i = end - 1; i >= first; --i) {
            if (!touched[i - first]) continue;
            const RecordOf<Profile>& s = records[ids[i]];
            const float* c = D == 3 ? s.color : job.colors + static_cast<int64_t>(ids[i]) * channels;
            backward_splat<D>(s, c, channels, grid, i, touched[i - first], blocks, moments, color);
            const int64_t pair = s.pair(job.tx, job.ty);
            store_sums<D>(moments, color, channels, job.pair_sums + pair * (Profile::MOMENTS + channels));
            job.pair_seen[pair] = 1;
        }
    }
}

// Computes one splat's gradient from the sums of its tile intersections [begin, end); a splat without any has no
// record.
template <class Profile>
void reduce_splat(const BlendArgs& a, const BlendGrads& out, int64_t camera, int64_t i, const RecordOf<Profile>& s,
                  int64_t begin, int64_t end, const float* pair_sums, const uint8_t* pair_seen, float* color) {
    constexpr int MOMENTS = Profile::MOMENTS;
    const int width = MOMENTS + a.D;
    FalloffMoments<float, Profile> m{};
    for (int k = 0; k < a.D; ++k) color[k] = 0.0f;
    for (int64_t pair = begin; pair < end; ++pair) {
        if (!pair_seen[pair]) continue;
        const float* sums = pair_sums + pair * width;
        for (int k = 0; k < MOMENTS; ++k) m.of[k] += sums[k];
        for (int k = 0; k < a.D; ++k) color[k] += sums[MOMENTS + k];
    }
    float g[MOMENTS] = {};
    if (begin < end && s.opacity > 0.0f) splat_gradient(m, s, g);
    const int64_t at = camera * a.N + i;
    out.means2d[at * 2] = g[0];
    out.means2d[at * 2 + 1] = g[1];
    for (int k = 0; k < 4; ++k) out.roots[at * 4 + k] = g[2 + k];
    float* g_color = out.colors + (a.color_per_camera ? at : i) * a.D;
    for (int k = 0; k < a.D; ++k) g_color[k] = color[k] + (a.color_per_camera || camera == 0 ? 0.0f : g_color[k]);
    if constexpr (Profile::HAS_SHAPE) {
        float* shape = out.shapes + (a.shape_per_camera ? at : i);
        *shape = g[6] + (a.shape_per_camera || camera == 0 ? 0.0f : *shape);
    }
}

template <class Profile>
void blend_backward_as(const BlendArgs& a, const BlendState& picture, const PictureGrads& grads,
                       const BlendGrads& out) {
    const int across = tiles_along(a.width), tiles = across * tiles_along(a.height);
    const size_t D = static_cast<size_t>(a.D), threads = static_cast<size_t>(a.threads);
    int64_t most_pairs = 0;
    for (int64_t c = 0; c < a.C; ++c) {
        const int64_t pairs = a.offsets[(c + 1) * tiles] - a.offsets[c * tiles];
        most_pairs = pairs > most_pairs ? pairs : most_pairs;
    }
    Buffer<RecordOf<Profile>> records(static_cast<size_t>(a.N));
    Buffer<int32_t> first_pairs(static_cast<size_t>(a.N) + 1);
    const size_t scratch_size = Blocks::size(a.D) + D * LANES;
    Buffer<float> scratch(scratch_size * threads), pair_sums(static_cast<size_t>(most_pairs) * (Profile::MOMENTS + D));
    Buffer<uint8_t> pair_seen(static_cast<size_t>(most_pairs));
    Buffer<float> background(D * static_cast<size_t>(tiles));

    for (int64_t c = 0; c < a.C; ++c) {
        make_records(a, c, records.data(), first_pairs.data());
        number_pairs(a, records.data(), first_pairs.data());
        pair_seen.zero();
        const float* colors = a.colors + (a.color_per_camera ? c * a.N * a.D : 0);
#pragma omp parallel for num_threads(a.threads) schedule(dynamic, 4)
        for (int tile = 0; tile < tiles; ++tile) {
            float* mine = scratch.data() + scratch_size * static_cast<size_t>(thread_index());
            const TileJob<Profile> job{a, picture, grads, records.data(), colors, c * tiles + tile, c, tile % across,
                                       tile / across, mine, mine + Blocks::size(a.D), pair_sums.data(),
                                       pair_seen.data(), background.data() + D * static_cast<size_t>(tile)};
            a.D == 3 ? backward_tile<3>(job) : backward_tile<0>(job);
        }
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N > SPLATS_PER_TASK)
        for (int64_t i = 0; i < a.N; ++i) {
            const size_t splat = static_cast<size_t>(i);
            float* color = scratch.data() + scratch_size * static_cast<size_t>(thread_index());
            reduce_splat(a, out, c, i, records[splat], first_pairs[splat], first_pairs[splat + 1], pair_sums.data(),
                         pair_seen.data(), color);
        }
        for (size_t k = 0; out.background && k < D; ++k) {
            double total = 0.0;
            for (size_t tile = 0; tile < static_cast<size_t>(tiles); ++tile) total += background[tile * D + k];
            out.background[k] += static_cast<float>(total);
        }
    }
}

}  // namespace

void blend_backward(const BlendArgs& a, const BlendState& picture, const PictureGrads& grads, const BlendGrads& out) {
    a.shapes ? blend_backward_as<Beta>(a, picture, grads, out) : blend_backward_as<Gaussian>(a, picture, grads, out);
}

}  // namespace GSB_ISA
}  // namespace gsb
