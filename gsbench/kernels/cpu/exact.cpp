// Renders an image in float64, and bounds at each pixel how far the image of blend.cpp in float32 can be from it.
//
// Let B_k be the colour that Gaussian k and all behind it show, so B_k = alpha_k c_k + (1 - alpha_k) B_(k+1), and the
// exact pixel is B_0. If float32 has summed S and has the transmittance T before Gaussian k, then S + T B_k changes by
//   T ((alpha' - alpha_k) (c_k - B_(k+1)) + alpha' (c' - c_k)) + rounding of the sum + (rounding of T) B_(k+1)
// when float32 blends alpha' and c'. The sum of the largest changes bounds the error of the pixel. alpha' lies in an
// interval (math/rounding.h). It is zero too if the Gaussian may be skipped or culled.
#include "../math/rounding.h"

#include "buffer.h"
#include "isa.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int BLOCK = 4;                                       // pixels along a block's side
constexpr int EXACT_COLUMNS = 8, SINGLE_COLUMNS = 11;          // of the arguments
constexpr int PAIRWISE = 16;                                   // largest group of tied depths whose pairs are looked at
constexpr double LEAST_ALPHA = 1.0 / 255, MOST_ALPHA = 0.999, LEAST_LEFT = 1e-4;  // in float64
constexpr double NOISE = 1e-15;                                // of the float64 arithmetic itself, relative

enum BlockArray { X, Y, P, Q, R, REACH, SX, SY, SP, SQ, SR, SREACH, SROOT, BLOCK_ARRAYS };

double magnitude(double x) { return x < 0 ? -x : x; }
double least(double a, double b) { return a < b ? a : b; }
double most(double a, double b) { return a > b ? a : b; }

// A Gaussian at a pixel. Its alpha is exact, and lies in [low, high] in float32.
struct Shown {
    double alpha, low, high;
    bool undecided;  // whether float32 may blend it where float64 does not, or the other way round
};

// A Gaussian in the list of a pixel, front to back.
struct Entry {
    int32_t id;
    bool may_stop;     // float32 may end the pixel here, where float64 goes on
    bool ended;        // float64 has ended the pixel
    bool behind;       // float32 has ended it too, but a tie in depth may bring the Gaussian before the end
    double alpha, low, high;
    double left;       // the largest transmittance before it in float32, in any order of equal depths
    double near, far;  // interval of its depth in float32
    double nearest;    // the smallest `near` of it and all behind it
    double share;      // of the bound, over all channels
};

// The memory of a thread; the arrays of a block have room for the longest list of a tile, `stride`.
struct Scratch {
    const double* reaches;  // [N, 2] of all threads: the power at which alpha is 1/255, in float64 and float32
    double* arrays;         // [BLOCK_ARRAYS, stride]
    int32_t* ids;
    uint8_t* kept;
    Entry* entries;
    double *behind, *sums, *total, *low, *high, *rest;  // [D]
    int64_t stride;

    double* array(BlockArray which) const { return arrays + which * stride; }
};

template <class Profile>
class Pixel {
public:
    Pixel(const ExactArgs& a, const Scratch& s, double x, double y) : a(a), s(s), x(x), y(y) {}

    // Blends the `count` Gaussians of the block, and writes results of the pixel at this index of the image.
    void run(int64_t count, int64_t at, const ExactPicture& out) {
        keep(count);
        front_to_back(count, out.image + at * a.D);
        for (int k = 0; k < a.D; ++k) s.total[k] = s.sums[k] = 0;
        ties();
        back_to_front();
        double bound = 0;
        for (int k = 0; k < a.D; ++k) {
            const double last = U * (s.sums[k] + 3 * magnitude(a.background[k]) * left_most);
            const double noise = NOISE * static_cast<double>(listed + 4) * (s.sums[k] + magnitude(a.background[k]));
            bound = most(bound, (s.total[k] + last) * 1.00001 + noise);
        }
        int32_t culprit = -1;
        double share = -1;
        for (int64_t i = 0; i < listed; ++i) {
            if (s.entries[i].share > share) {
                share = s.entries[i].share;
                culprit = s.entries[i].id;
            }
        }
        out.bound[at] = bound;
        out.culprit[at] = culprit;
        out.branches[at] = branches;
    }

private:
    const ExactArgs& a;
    const Scratch& s;
    const double x, y;
    int64_t listed = 0;
    double left_most = 1;  // transmittance behind the last Gaussian, at most
    uint8_t branches = 0;

    // Marks the Gaussians whose alpha may be at least 1/255 here, in float64 or float32.
    void keep(int64_t count) {
        const double *xs = s.array(X), *ys = s.array(Y), *p = s.array(P), *q = s.array(Q), *r = s.array(R);
        const double *sx = s.array(SX), *sy = s.array(SY), *sp = s.array(SP), *sq = s.array(SQ), *sr = s.array(SR);
        const double *reach = s.array(REACH), *single_reach = s.array(SREACH), *root = s.array(SROOT);
        uint8_t* kept = s.kept;
        for (int64_t i = 0; i < count; ++i) {
            const double dx = x - xs[i], dy = y - ys[i], w = p[i] * dx, u = q[i] * dx + r[i] * dy;
            const double ex = x - sx[i], ey = y - sy[i], v = sp[i] * ex, qx = sq[i] * ex, ry = sr[i] * ey;
            const double slack = 4 * U * (std::abs(v) + std::abs(qx) + std::abs(ry));
            const double power = v * v + (qx + ry) * (qx + ry);
            kept[i] = (w * w + u * u <= reach[i]) | (power <= single_reach[i] + slack * (root[i] + slack));
        }
    }

    Shown show(int32_t id) const {
        const double *exact = a.exact + static_cast<int64_t>(id) * EXACT_COLUMNS;
        const double *single = a.single + static_cast<int64_t>(id) * SINGLE_COLUMNS;
        Shown out{0, 0, 0, false};
        if (exact[5] > 0) {
            const ExactSplat splat{exact[0], exact[1], exact[2], exact[3], exact[4], exact[5], exact[6]};
            const double alpha = least(ExactFalloff<Profile>::value(splat, ExactOffset(splat, x, y)), MOST_ALPHA);
            out.alpha = alpha >= LEAST_ALPHA ? alpha : 0;
        }
        const double half = single[7];
        if (half > 0) {
            const ExactSplat splat{single[0], single[1], single[2], single[3], single[4], single[5], single[6]};
            const ExactOffset offset(splat, x, y);
            const Interval free = ExactFalloff<Profile>::single(splat, offset);
            // float32 looks only at pixels in the bounding box, and at blocks of pixels that the ellipse touches.
            const double beside = power_error(splat, offset, BLOCK) * 2 + 2 * U * offset.power, reach = half * splat.p;
            const bool looked_at = single[9] > 0 && magnitude(offset.dx) <= half - 2 * U * magnitude(splat.x) &&
                                   magnitude(offset.dy) <= single[8] - 2 * U * magnitude(splat.y) &&
                                   offset.power + beside <= reach * reach * (1 - 4 * U);
            const double high = least(free.high, static_cast<double>(ALPHA_MAX));
            const double low = least(free.low, static_cast<double>(ALPHA_MAX));
            if (high >= static_cast<double>(ALPHA_MIN)) {
                out.high = high;
                if (looked_at && low >= static_cast<double>(ALPHA_MIN)) out.low = low;
            }
        }
        out.undecided = (out.alpha > 0) != (out.high > 0) || (out.high > 0 && out.low == 0);
        return out;
    }

    // Blends the exact image, and lists what float64 or float32 blends until both have ended the pixel.
    void front_to_back(int64_t count, double* image) {
        double left = 1, least_left = 1, far = -1;
        bool ended = false, finished = false;
        for (int k = 0; k < a.D; ++k) image[k] = 0;
        for (int64_t i = 0; i < count; ++i) {
            if (!s.kept[i]) continue;
            const int32_t id = s.ids[i];
            const double depth = a.exact[static_cast<int64_t>(id) * EXACT_COLUMNS + 7];
            const double error = a.single[static_cast<int64_t>(id) * SINGLE_COLUMNS + 10];
            if (finished && depth - a.depth_error > far) break;
            const Shown c = show(id);
            if (c.alpha == 0 && c.high == 0) continue;
            if (!finished || depth - error <= far) far = most(far, depth + error);
            Entry& entry = s.entries[listed++];
            entry = {id, false, true, finished, 0, 0, 0, left_most, depth - error, depth + error, 0, 0};
            if (finished) continue;
            if (!ended && c.alpha > 0 && left * (1 - c.alpha) < LEAST_LEFT) ended = true;
            const double after_most = left_most * (1 - c.low) + 2 * U * left_most;
            const double after_least = most(least_left * (1 - c.high) - 2 * U * least_left, 0);
            const bool may_stop = c.high > 0 && after_least < static_cast<double>(TRANSMITTANCE_MIN);
            if (ended && c.low > 0 && after_most < static_cast<double>(TRANSMITTANCE_MIN)) {
                finished = true;
                continue;
            }
            branches |= (c.undecided ? SKIPPED : 0) | (ended || may_stop ? STOPPED : 0);
            entry.ended = ended;
            entry.may_stop = may_stop && !ended;
            entry.alpha = ended ? 0 : c.alpha;
            entry.low = c.low;
            entry.high = c.high;
            const double* color = color_of(id);
            for (int k = 0; k < a.D; ++k) image[k] += left * entry.alpha * color[k];
            left *= 1 - entry.alpha;
            left_most = least(after_most, left_most);
            least_left = after_least;
        }
        for (int k = 0; k < a.D; ++k) image[k] += left * a.background[k];
    }

    // Sums the largest changes of the pixel, with the exact colour behind each Gaussian.
    void back_to_front() {
        for (int k = 0; k < a.D; ++k) s.behind[k] = a.background[k];
        for (int k = 0; k < a.D; ++k) s.rest[k] = s.sums[k];
        for (int64_t i = listed - 1; i >= 0; --i) {
            Entry& e = s.entries[i];
            const double *color = color_of(e.id), *color_error = error_of(e.id);
            const double change = most(e.high - e.alpha, e.alpha - e.low);
            for (int k = 0; k < a.D; ++k) {
                const double size = magnitude(color[k]) + color_error[k], behind = s.behind[k];
                double term = change * magnitude(color[k] - behind) + e.high * color_error[k];
                term += e.high * size * 2.01 * U + 2.01 * U * magnitude(behind);
                term = term * e.left + U * s.rest[k];
                s.behind[k] = e.alpha * color[k] + (1 - e.alpha) * behind;
                if (e.may_stop) term += e.left * magnitude(s.behind[k] - a.background[k]);
                s.rest[k] -= e.left * e.high * size;
                s.total[k] += term;
                e.share += term;
            }
        }
    }

    // Adds what the order of Gaussians can change whose depths are equal within their errors in float32, and sums the
    // size of what is blended.
    void ties() {
        double loose = 1;  // of the other errors, on which the order acts too
        for (int64_t i = listed - 1; i >= 0; --i) {
            Entry& e = s.entries[i];
            loose += e.high - e.low;
            if (i + 1 < listed) e.nearest = least(e.near, s.entries[i + 1].nearest);
            else e.nearest = e.near;
        }
        int64_t first = 0;
        while (first < listed) {
            double far = s.entries[first].far;
            int64_t end = first + 1;
            while (end < listed && s.entries[end].nearest <= far) far = most(far, s.entries[end++].far);
            if (end - first > 1 && !s.entries[first].behind) group(first, end, loose);
            for (int64_t i = first; i < end; ++i) {
                Entry& e = s.entries[i];
                e.left = s.entries[first].left;
                const double *color = color_of(e.id), *error = error_of(e.id);
                for (int k = 0; k < a.D; ++k) s.sums[k] += e.left * e.high * (magnitude(color[k]) + error[k]);
            }
            first = end;
        }
    }

    void group(int64_t first, int64_t end, double loose) {
        branches |= ORDERED;
        bool stops = false;
        for (int64_t i = first; i < end; ++i) stops |= s.entries[i].may_stop || s.entries[i].ended;
        const double left = s.entries[first].left;
        if (!stops && end - first <= PAIRWISE) {
            // Another order is reached by swaps of neighbours, each pair at most once.
            for (int64_t j = first; j < end; ++j) {
                for (int64_t i = first; i < j; ++i) swap(s.entries[i], s.entries[j], left * loose);
            }
            return;
        }
        double pass = 1;
        for (int64_t i = first; i < end; ++i) {
            const double *color = color_of(s.entries[i].id), *error = error_of(s.entries[i].id);
            pass *= 1 - most(s.entries[i].high, s.entries[i].alpha);
            for (int k = 0; k < a.D; ++k) {
                const bool start = i == first;
                s.low[k] = least(start ? (stops ? a.background[k] : color[k]) : s.low[k], color[k] - error[k]);
                s.high[k] = most(start ? (stops ? a.background[k] : color[k]) : s.high[k], color[k] + error[k]);
            }
        }
        for (int k = 0; k < a.D; ++k) {
            const double jump = left * loose * (stops ? 1 : 1 - pass) * (s.high[k] - s.low[k]);
            s.total[k] += jump;
            s.entries[first].share += jump;
        }
    }

    void swap(const Entry& i, Entry& j, double left) const {
        if (i.far < j.near) return;  // they are tied by others between them, but keep their order
        const double both = left * most(i.high, i.alpha) * most(j.high, j.alpha);
        const double *one = color_of(i.id), *two = color_of(j.id), *e = error_of(i.id), *f = error_of(j.id);
        for (int k = 0; k < a.D; ++k) {
            const double jump = both * (magnitude(one[k] - two[k]) + e[k] + f[k]);
            s.total[k] += jump;
            j.share += jump;
        }
    }

    const double* color_of(int32_t id) const { return a.colors + static_cast<int64_t>(id) * a.D; }
    const double* error_of(int32_t id) const { return a.color_errors + static_cast<int64_t>(id) * a.D; }
};

// Returns the largest power at which alpha is at least 1/255, a little enlarged; -1 if there is none.
template <class Profile>
double reach_of(double opacity, double shape) {
    const double above = opacity * 255;
    if (above < 1 - 1e-5) return -1;
    const double r2 = Profile::HAS_SHAPE ? -std::expm1(-std::log(most(above, 1)) / shape) : 2 * std::log(most(above, 1));
    return r2 * 0.7213475204444817 * (1 + 1e-5) + 1e-5;
}

// Copies the Gaussians that may touch the block at (left, top) to the scratch memory; returns their number.
int64_t gather_block(const ExactArgs& a, const Scratch& s, int64_t tile, int left, int top) {
    const float x = static_cast<float>(left) + 0.5f * BLOCK, y = static_cast<float>(top) + 0.5f * BLOCK;
    int64_t count = 0;
    for (int32_t at = a.offsets[tile]; at < a.offsets[tile + 1]; ++at) {
        const int64_t id = a.ids[at];
        const float dx = std::abs(a.means2d[id * 2] - x), dy = std::abs(a.means2d[id * 2 + 1] - y);
        if (dx > a.half_sizes[id * 2] + 0.5f * BLOCK || dy > a.half_sizes[id * 2 + 1] + 0.5f * BLOCK) continue;
        const double *exact = a.exact + id * EXACT_COLUMNS, *single = a.single + id * SINGLE_COLUMNS;
        for (int k = 0; k < 5; ++k) s.array(static_cast<BlockArray>(X + k))[count] = exact[k];
        for (int k = 0; k < 5; ++k) s.array(static_cast<BlockArray>(SX + k))[count] = single[k];
        s.array(REACH)[count] = s.reaches[id * 2];
        const double reach = s.reaches[id * 2 + 1];
        s.array(SREACH)[count] = reach < 0 ? -1e300 : reach;
        s.array(SROOT)[count] = reach < 0 ? 0 : 2 * std::sqrt(reach);
        s.ids[count++] = static_cast<int32_t>(id);
    }
    return count;
}

template <class Profile>
void exact_tile(const ExactArgs& a, const Scratch& s, int64_t tile, const ExactPicture& out) {
    const int across = tiles_along(a.width);
    const int left = static_cast<int>(tile % across) * TILE, top = static_cast<int>(tile / across) * TILE;
    for (int by = top; by < top + TILE && by < a.height; by += BLOCK) {
        for (int bx = left; bx < left + TILE && bx < a.width; bx += BLOCK) {
            const int64_t count = gather_block(a, s, tile, bx, by);
            for (int py = by; py < by + BLOCK && py < a.height; ++py) {
                for (int px = bx; px < bx + BLOCK && px < a.width; ++px) {
                    Pixel<Profile>(a, s, px + 0.5, py + 0.5).run(count, static_cast<int64_t>(py) * a.width + px, out);
                }
            }
        }
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
    const size_t n = static_cast<size_t>(longest);
    Buffer<double> reaches(static_cast<size_t>(a.N) * 2);
#pragma omp parallel num_threads(a.threads)
    {
#pragma omp for schedule(static)
        for (int64_t i = 0; i < a.N; ++i) {
            const double *exact = a.exact + i * EXACT_COLUMNS, *single = a.single + i * SINGLE_COLUMNS;
            double* reach = &reaches[static_cast<size_t>(i) * 2];
            reach[0] = a.beta ? reach_of<Beta>(exact[5], exact[6]) : reach_of<Gaussian>(exact[5], exact[6]);
            reach[1] = single[7] <= 0 ? -1 : a.beta ? reach_of<Beta>(single[5], single[6]) : reach_of<Gaussian>(single[5], single[6]);
        }
        Buffer<double> arrays(n * BLOCK_ARRAYS), channels(static_cast<size_t>(a.D) * 6);
        Buffer<int32_t> ids(n);
        Buffer<uint8_t> kept(n);
        Buffer<Entry> entries(n);
        double* c = channels.data();
        const Scratch s{reaches.data(), arrays.data(), ids.data(),  kept.data(), entries.data(), c,
                        c + a.D,        c + 2 * a.D,   c + 3 * a.D, c + 4 * a.D, c + 5 * a.D,    longest};
#pragma omp for schedule(dynamic, 4)
        for (int64_t tile = 0; tile < tiles; ++tile) {
            a.beta ? exact_tile<Beta>(a, s, tile, out) : exact_tile<Gaussian>(a, s, tile, out);
        }
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
