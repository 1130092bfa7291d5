// The gradient of blending: every tile back to front, then every splat over its tiles.
//
// A pair of tile and splat writes its sums to a place of its own, and each splat adds up its pairs in their order, so
// that the result has the same bits for any number of threads.
#include "buffer.h"
#include "isa.h"
#include "tile.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int GEOMETRY = 6;  // moments of a pair, before its D sums of colour
constexpr int64_t SPLATS_PER_TASK = 512;

struct TileJob {
    const BlendArgs& args;
    const Picture& picture;
    const BlendGrads& grads;
    const Record* records;
    const float* colors;
    int64_t tile, camera;
    int tx, ty;
    float* g_color;     // scratch, [D][256]: gradient of the picture
    float* color_sums;  // scratch, [D][16] or more
    float* pair_sums;   // [pairs][6 + D]
    uint8_t* pair_seen;
    float* background;   // [D] of this tile
};

// The picture's gradient in the order of blocks, and what lies behind everything: the background's share of it.
template <int D>
void load_gradient(const TileJob& job, const TileGrid& grid, float* behind) {
    const BlendArgs& a = job.args;
    const int channels = D ? D : a.D;
    const float* T = job.picture.transmittance + job.tile * TILE_PIXELS;
    for (int k = 0; k < channels * TILE_PIXELS; ++k) job.g_color[k] = 0.0f;
    for (int k = 0; k < TILE_PIXELS; ++k) behind[k] = 0.0f;
    each_row(grid, [&](int at, int x, int y, int n) {
        const int64_t pixel = (job.camera * a.height + y) * a.width + x;
        const float *image = job.grads.image + pixel * channels, *alpha = job.grads.alpha + pixel;
        if (D && n == BLOCK) {  // the same as below, unrolled
            for (int i = 0; i < BLOCK; ++i) {
                behind[at + i] = -alpha[i];
                for (int k = 0; k < D; ++k) job.g_color[k * TILE_PIXELS + at + i] = image[i * D + k];
            }
            return;
        }
        for (int i = 0; i < n; ++i) {
            behind[at + i] = -alpha[i];
            for (int k = 0; k < channels; ++k) job.g_color[k * TILE_PIXELS + at + i] = image[i * channels + k];
        }
    });
    for (int k = 0; k < channels; ++k) {
        const float* g_color = job.g_color + k * TILE_PIXELS;
        Vec total(0.0f);
        for (int at = 0; at < TILE_PIXELS; at += LANES) {
            const Vec g = Vec::load(g_color + at);
            total += g * Vec::load(T + at);
            (Vec::load(behind + at) + g * a.background[k]).store(behind + at);
        }
        job.background[k] = sum(total);
    }
}

template <int D>
void store_sums(const FalloffMoments<Vec>& m, const Vec* color, int channels, float* out) {
    alignas(64) float sums[8];
    if constexpr (D == 3) {
        sum4(m.v, m.u, m.w, m.w_dx, out);
        sum4(m.u_dx, m.u_dy, color[0], color[1], out + 4);
        sum4(color[2], color[2], color[2], color[2], sums);
        out[8] = sums[0];
    } else {
        sum4(m.v, m.u, m.w, m.w_dx, out);
        sum4(m.u_dx, m.u_dy, m.v, m.v, sums);
        out[4] = sums[0];
        out[5] = sums[1];
        for (int k = 0; k < channels; ++k) out[GEOMETRY + k] = sum(color[k]);
    }
}

// One splat, the i-th of its tile, over the blocks it touches: its pair's sums, and the state of the pixels before it.
template <int D>
GSB_HD inline void backward_splat(const TileJob& job, const TileGrid& grid, int64_t i, int32_t id, uint32_t blocks,
                                  float* T, float* behind, Vec* color) {
    const Record& s = job.records[id];
    const int channels = D ? D : job.args.D;
    const float *stop = job.picture.stop + job.tile * TILE_PIXELS,
                *c = D == 3 ? s.color : job.colors + static_cast<int64_t>(id) * channels;
    const Vec position(static_cast<float>(i)), zero(0.0f);
    FalloffMoments<Vec> moments{zero, zero, zero, zero, zero, zero};
    for (int k = 0; k < channels; ++k) color[k] = zero;
    for (; blocks; blocks &= blocks - 1) {
        const int b = __builtin_ctz(blocks), at = b * LANES;
        const Falloff<Vec> f(grid.lane_x[b & 3] - s.x, grid.lane_y[b >> 2] - s.y, s.p, s.q, s.r, s.opacity);
        const Mask blended = (f.alpha >= Vec(ALPHA_MIN)) & (position < Vec::load(stop + at));
        const Vec alpha = select(blended, f.alpha, zero);
        const Vec before = Vec::load(T + at) * reciprocal(Vec(1.0f) - alpha);
        const Vec weight = alpha * before;
        before.store(T + at);
        Vec g(0.0f);  // of the splat's own colour
        for (int k = 0; k < channels; ++k) {
            const Vec g_color = Vec::load(job.g_color + k * TILE_PIXELS + at);
            g += g_color * c[k];
            color[k] += weight * g_color;
        }
        // dC/dalpha = T (c - what is seen behind the splat); seen behind the next one nearer: a mix of the two.
        const Vec back = Vec::load(behind + at), difference = g - back;
        (back + alpha * difference).store(behind + at);
        moments.add(f, select(f.free <= Vec(ALPHA_MAX), weight * difference, zero));
    }
    const int64_t pair = s.pair(job.tx, job.ty);
    store_sums<D>(moments, color, channels, job.pair_sums + pair * (GEOMETRY + channels));
    job.pair_seen[pair] = 1;
}

template <int D>
void backward_tile(const TileJob& job) {
    const BlendArgs& a = job.args;
    const TileGrid grid(job.tx, job.ty, a.width, a.height);
    const int32_t* ids = a.ids + a.offsets[job.tile];
    const float* stop = job.picture.stop + job.tile * TILE_PIXELS;
    alignas(64) float T[TILE_PIXELS], behind[TILE_PIXELS], block_stop[BLOCKS];
    load_gradient<D>(job, grid, behind);
    __builtin_memcpy(T, job.picture.transmittance + job.tile * TILE_PIXELS, sizeof(T));
    float last = 0.0f;
    for (int b = 0; b < BLOCKS; ++b) {
        block_stop[b] = 0.0f;
        for (int lane = 0; lane < LANES; ++lane) block_stop[b] = max(block_stop[b], stop[b * LANES + lane]);
        last = max(last, block_stop[b]);
    }
    const Vec stops = Vec::load(block_stop), zero(0.0f);
    Vec local[D ? D : 1];
    Vec* color = D ? local : reinterpret_cast<Vec*>(job.color_sums);

    uint32_t touched[BATCH];  // found for many splats at once, so that no branch waits for it
    for (int64_t end = static_cast<int64_t>(last); end > 0; end -= BATCH) {
        const int64_t first = end > BATCH ? end - BATCH : 0;
        for (int64_t i = end - 1; i >= first; --i) {
            __builtin_prefetch(job.records + ids[i < AHEAD ? 0 : i - AHEAD]);
            touched[i - first] = grid.touched(job.records[ids[i]]) & bits(Vec(static_cast<float>(i)) < stops);
        }
        for (int64_t i = end - 1; i >= first; --i) {
            if (touched[i - first]) backward_splat<D>(job, grid, i, ids[i], touched[i - first], T, behind, color);
        }
    }
}

// One splat's gradient from its pairs.
void reduce_splat(const BlendArgs& a, const BlendGrads& out, int64_t camera, int64_t i, const Record& s, int64_t end,
                  const float* pair_sums, const uint8_t* pair_seen, float* color) {
    const int width = GEOMETRY + a.D;
    FalloffMoments<float> m{};
    for (int k = 0; k < a.D; ++k) color[k] = 0.0f;
    for (int64_t pair = s.first_pair; pair < end; ++pair) {
        if (!pair_seen[pair]) continue;
        const float* sums = pair_sums + pair * width;
        m.v += sums[0];
        m.u += sums[1];
        m.w += sums[2];
        m.w_dx += sums[3];
        m.u_dx += sums[4];
        m.u_dy += sums[5];
        for (int k = 0; k < a.D; ++k) color[k] += sums[GEOMETRY + k];
    }
    float g[GEOMETRY] = {};
    if (s.opacity > 0.0f) splat_gradient(m, s.p, s.q, s.r, s.opacity, g);
    const int64_t at = camera * a.N + i;
    out.means2d[at * 2] = g[0];
    out.means2d[at * 2 + 1] = g[1];
    for (int k = 0; k < 3; ++k) out.roots[at * 3 + k] = g[2 + k];
    out.opacities[at] = g[5];
    float* g_color = out.colors + (a.color_per_camera ? at : i) * a.D;
    for (int k = 0; k < a.D; ++k) g_color[k] = color[k] + (a.color_per_camera || camera == 0 ? 0.0f : g_color[k]);
}

}  // namespace

void blend_backward(const BlendArgs& a, const Picture& picture, const BlendGrads& out) {
    const int across = tiles_along(a.width), tiles = across * tiles_along(a.height);
    const size_t D = static_cast<size_t>(a.D), threads = static_cast<size_t>(a.threads);
    int64_t most_pairs = 0;
    for (int64_t c = 0; c < a.C; ++c) {
        const int64_t pairs = a.offsets[(c + 1) * tiles] - a.offsets[c * tiles];
        most_pairs = pairs > most_pairs ? pairs : most_pairs;
    }
    Buffer<Record> records(static_cast<size_t>(a.N));
    const size_t scratch_size = D * (TILE_PIXELS + LANES);
    Buffer<float> scratch(scratch_size * threads), pair_sums(static_cast<size_t>(most_pairs) * (GEOMETRY + D));
    Buffer<uint8_t> pair_seen(static_cast<size_t>(most_pairs));
    Buffer<float> background(D * static_cast<size_t>(tiles));
    for (size_t k = 0; k < D; ++k) out.background[k] = 0.0f;

    for (int64_t c = 0; c < a.C; ++c) {
        const int64_t pairs = make_records(a, c, records.data());
        pair_seen.zero();
        const float* colors = a.colors + (a.color_per_camera ? c * a.N * a.D : 0);
#pragma omp parallel for num_threads(a.threads) schedule(dynamic, 4)
        for (int tile = 0; tile < tiles; ++tile) {
            float* mine = scratch.data() + scratch_size * static_cast<size_t>(thread_index());
            const TileJob job{a, picture, out, records.data(), colors, c * tiles + tile, c, tile % across,
                              tile / across, mine, mine + D * TILE_PIXELS, pair_sums.data(), pair_seen.data(),
                              background.data() + D * static_cast<size_t>(tile)};
            a.D == 3 ? backward_tile<3>(job) : backward_tile<0>(job);
        }
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N > SPLATS_PER_TASK)
        for (int64_t i = 0; i < a.N; ++i) {
            const int64_t end = i + 1 < a.N ? records[static_cast<size_t>(i) + 1].first_pair : pairs;
            float* color = scratch.data() + scratch_size * static_cast<size_t>(thread_index());
            reduce_splat(a, out, c, i, records[static_cast<size_t>(i)], end, pair_sums.data(), pair_seen.data(), color);
        }
        for (size_t k = 0; k < D; ++k) {
            double total = 0.0;
            for (size_t tile = 0; tile < static_cast<size_t>(tiles); ++tile) total += background[tile * D + k];
            out.background[k] += static_cast<float>(total);
        }
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
