// Renders an image in float64, and bounds at each pixel how far the image of blend.cpp in float32 can be from it.
//
// Let B_k be the colour that Gaussian k and all behind it show, so B_k = alpha_k c_k + (1 - alpha_k) B_(k+1), and the
// exact pixel is B_0. If float32 has summed S and has the transmittance T before Gaussian k, then S + T B_k changes by
//   T ((alpha' - alpha_k) (c_k - B_(k+1)) + alpha' (c' - c_k)) + rounding of the sum + (rounding of T) B_(k+1)
// when float32 blends alpha' and c'. The sum of the largest changes bounds the error of the pixel. alpha' lies in an
// interval (math/rounding.h). It is zero too if the Gaussian may be skipped or culled.
#include "buffer.h"
#include "exact_strip.h"
#include "isa.h"
#include "tile.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int ACROSS = TILE / STRIP_WIDTH, STRIPS = ACROSS * TILE / STRIP_HEIGHT;  // of a tile
static_assert(STRIPS == 32 && DOUBLES % ACROSS == 0);

template <class Number>
ExactSplat splat_of(const Number (&x)[7]) {
    return {x[0], x[1], x[2], x[3], x[4], x[5], x[6]};
}

// The strips of a tile, and which of them a Gaussian may reach.
struct Strips {
    int left, top;  // of the tile
    Doubles x0[STRIPS / DOUBLES], y0[STRIPS / DOUBLES];  // first pixel centres of the strips

    Strips(int left, int top) : left(left), top(top) {
        for (int i = 0; i < STRIPS / DOUBLES; ++i) {
            alignas(64) double x[DOUBLES], y[DOUBLES];
            for (int l = 0; l < DOUBLES; ++l) {
                x[l] = left + (i * DOUBLES + l) % ACROSS * STRIP_WIDTH + 0.5;
                y[l] = top + (i * DOUBLES + l) / ACROSS * STRIP_HEIGHT + 0.5;
            }
            x0[i] = Doubles::load(x);
            y0[i] = Doubles::load(y);
        }
    }

    // Returns the largest error of u and of w in float32, at most this many pixels outside of the tile.
    double root_error(const ExactSplat& s, double beside) const {
        const double dx = most(magnitude(left - s.x), magnitude(left + TILE - s.x)) + beside;
        const double dy = most(magnitude(top - s.y), magnitude(top + TILE - s.y)) + beside;
        return 3.01 * U * (most(magnitude(s.p), magnitude(s.q)) * dx + magnitude(s.r) * dy);
    }

    // Returns bits of the strips with a pixel where the root of the power is at most `root`, and a little more, because
    // alpha may round up to 1/255 there.
    uint32_t reached(const ExactSplat& s, double root) const {
        const double most_power = root * root * (1 + 1e-5) + 1e-5;
        const double foot_y = -s.q / s.r, foot_x = -s.q * s.r / (s.p * s.p + s.q * s.q);
        uint32_t found = 0;
        for (int i = 0; i < STRIPS / DOUBLES; ++i) {
            const Doubles x = x0[i] - s.x, y = y0[i] - s.y;
            const Doubles x1 = x + (STRIP_WIDTH - 1.0), y1 = y + (STRIP_HEIGHT - 1.0);
            const Doubles power = least_power<Doubles>(x, x1, y, y1, s.p, s.q, s.r, foot_x, foot_y);
            found |= bits(power <= most_power) << i * DOUBLES;
        }
        return found;
    }
};

// Returns the power up to which float32 surely looks at the pixels of the tile: they are in the bounding box of the
// Gaussian, and in blocks of pixels that its ellipse touches.
double sure_power(const ExactSplat& s, double half_x, double half_y, const Strips& strips) {
    const double x = half_x - 2 * U * magnitude(s.x), y = half_y - 2 * U * magnitude(s.y);
    if (x <= 0 || y <= 0) return -1;
    const double root_x = x * s.p, root_y = y * s.p * s.r / std::sqrt(s.p * s.p + s.q * s.q);
    const double error = strips.root_error(s, BLOCK);
    const double root = least(root_x, root_y) * (1 - 8 * U), power = root * root;
    return power - 8 * error * (root + error);
}

// Returns a Gaussian in the list of a tile, and bits of the strips that it may reach in float64 or in float32.
Listed listed_of(const ExactRecord& record, int32_t id, const Strips& strips, uint32_t& reached) {
    Listed g{};
    g.id = id;
    g.near = record.depth - record.depth_error;
    g.far = record.depth + record.depth_error;
    g.sure = -1;
    reached = 0;
    if (record.half_x > 0) {
        g.exact = splat_of(record.exact);
        reached |= strips.reached(g.exact, record.half_x * g.exact.p);
    }
    if (record.single_half_x > 0) {
        const double half_x = record.single_half_x;
        g.single = splat_of(record.single);
        reached |= strips.reached(g.single, half_x * g.single.p * (1 + 4 * U) + 2 * strips.root_error(g.single, 0));
        if (record.sure) g.sure = sure_power(g.single, half_x, record.single_half_y, strips);
        if (record.half_x > 0) g.opacity_ratio = g.single.opacity / g.exact.opacity;
    }
    return g;
}

// Copies a tile's list, sorted by the exact depth. It was sorted by the depth in float32, so that few are moved.
void sort_exactly(const ExactArgs& a, const int32_t* from, int64_t count, int32_t* ids) {
    for (int64_t i = 0; i < count; ++i) {
        __builtin_prefetch(a.records + from[i + AHEAD < count ? i + AHEAD : i]);
        int64_t at = i;
        for (; at > 0 && a.records[ids[at - 1]].depth > a.records[from[i]].depth; --at) ids[at] = ids[at - 1];
        ids[at] = from[i];
    }
}

// The memory of a thread, with room for the longest list of a tile.
struct TileMemory {
    const int64_t longest;
    Buffer<Listed> listed;
    Buffer<Paint> paints;    // [longest, D]
    Buffer<int32_t> ids;
    Buffer<int32_t> places;  // [STRIPS, longest]: of the tile's Gaussians those that may reach a strip
    Buffer<Entry> entries;
    Buffer<Entry*> members;
    Buffer<double> nearest, channels;

    TileMemory(int64_t longest, int D)
        : longest(longest), listed(static_cast<size_t>(longest)), paints(static_cast<size_t>(longest * D)),
          ids(static_cast<size_t>(longest)), places(static_cast<size_t>(longest * STRIPS)),
          entries(static_cast<size_t>(longest)), members(static_cast<size_t>(longest)),
          nearest(static_cast<size_t>(longest)), channels(static_cast<size_t>(5 * D * DOUBLES)) {}

    Scratch scratch(int D) {
        double* c = channels.data();
        const int size = D * DOUBLES;
        return {entries.data(), members.data(), nearest.data(), c, c + size, c + 2 * size, c + 3 * size, c + 4 * size};
    }
};

template <class Profile, int D>
void exact_tile(const ExactArgs& a, TileMemory& memory, int64_t tile, const ExactPicture& out) {
    const int across = tiles_along(a.width);
    const Strips strips(static_cast<int>(tile % across) * TILE, static_cast<int>(tile / across) * TILE);
    const int64_t count = a.offsets[tile + 1] - a.offsets[tile];
    int32_t* ids = memory.ids.data();
    int64_t counts[STRIPS] = {};
    Listed* listed = memory.listed.data();
    Paint* paints = memory.paints.data();
    int32_t* places = memory.places.data();
    double nearest = INFINITY;
    sort_exactly(a, a.ids + a.offsets[tile], count, ids);
    for (int64_t i = 0; i < count; ++i) {
        const int64_t next = ids[i + AHEAD < count ? i + AHEAD : i];
        __builtin_prefetch(&a.records[next].depth_error);  // in the other cache line
        __builtin_prefetch(a.colors + next * a.D);
        __builtin_prefetch(a.single_colors + next * a.D);
        uint32_t reached;
        listed[i] = listed_of(a.records[ids[i]], ids[i], strips, reached);
        const int64_t color = static_cast<int64_t>(ids[i]) * a.D;
        for (int k = 0; k < a.D; ++k) {
            const double exact = a.colors[color + k];
            paints[i * a.D + k] = Paint(exact, magnitude(a.single_colors[color + k] - exact));
        }
        for (; reached; reached &= reached - 1) {
            const int strip = __builtin_ctz(reached);
            places[strip * memory.longest + counts[strip]++] = static_cast<int32_t>(i);
        }
    }
    for (int64_t i = count - 1; i >= 0; --i) {
        nearest = least(nearest, listed[i].near);
        listed[i].nearest = nearest;
    }
    for (int i = 0; i < STRIPS; ++i) {
        const int left = strips.left + i % ACROSS * STRIP_WIDTH, top = strips.top + i / ACROSS * STRIP_HEIGHT;
        if (left >= a.width || top >= a.height) continue;
        Strip<Profile, D> strip(a, memory.scratch(a.D), left, top);
        strip.run(listed, paints, places + i * memory.longest, counts[i], out);
    }
}

}  // namespace

void exact_image(const ExactArgs& a, const ExactPicture& out) {
    const int64_t tiles = static_cast<int64_t>(tiles_along(a.width)) * tiles_along(a.height);
    int64_t longest = 1;
    for (int64_t t = 0; t < tiles; ++t) {
        const int64_t count = a.offsets[t + 1] - a.offsets[t];
        longest = count > longest ? count : longest;
    }
#pragma omp parallel num_threads(a.threads)
    {
        TileMemory memory(longest, a.D);
#pragma omp for schedule(dynamic, 4)
        for (int64_t tile = 0; tile < tiles; ++tile) {
            const auto render = a.D == 3 ? (a.beta ? exact_tile<Beta, 3> : exact_tile<Gaussian, 3>)
                                         : (a.beta ? exact_tile<Beta, 0> : exact_tile<Gaussian, 0>);
            render(a, memory, tile, out);
        }
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
