// A strip of 4 x 2 pixels, one SIMD vector of doubles: its exact image, and the bound on the error of the image in
// float32. exact.cpp renders the strips, and has the formula of the bound.
#pragma once

#include <initializer_list>

#include "../math/rounding.h"
#include "doubles.h"
#include "kernels.h"

namespace gsb {
inline namespace GSB_ISA {

constexpr int STRIP_WIDTH = 4, STRIP_HEIGHT = 2;
static_assert(STRIP_WIDTH * STRIP_HEIGHT == DOUBLES);
alignas(64) constexpr double STRIP_COLUMN[DOUBLES] = {0, 1, 2, 3, 0, 1, 2, 3};  // of a lane
alignas(64) constexpr double STRIP_ROW[DOUBLES] = {0, 0, 0, 0, 1, 1, 1, 1};

constexpr int PAIRWISE = 16;  // largest group of tied depths whose pairs are looked at
constexpr double MOST_ALPHA = 0.999, LEAST_LEFT = 1e-4;  // in float64
constexpr double NOISE = 1e-15;  // of the float64 arithmetic itself, relative

inline double magnitude(double x) { return x < 0 ? -x : x; }
inline double least(double a, double b) { return a < b ? a : b; }
inline double most(double a, double b) { return a > b ? a : b; }

// A Gaussian in the list of a tile, front to back.
struct Listed {
    ExactSplat exact, single;  // in float64 and in float32; all zero: culled
    double opacity_ratio;      // float32 to float64; 0 where either is culled
    double sure;               // float32 surely looks at pixels of the tile where its power is at most this
    double near, far;          // interval of the depth in float32
    double nearest;            // the smallest `near` of it and all behind it
    int32_t id;
};

// A channel of a colour. Its size is the largest magnitude in float32; its rate times alpha is the error of what is
// blended, if alpha is exact.
struct Paint {
    double color, error, size, rate;

    Paint(double color, double error)
        : color(color), error(error), size(magnitude(color) + error), rate(error + 2.01 * U * size) {}
};

// A Gaussian at the pixels of a strip. Its alpha is exact, and lies in [low, high] in float32.
struct Shown {
    Doubles alpha, low, high;
    DoubleMask undecided;  // whether float32 may blend it where float64 does not, or the other way round
};

// A Gaussian that float64 or float32 blends in a pixel of a strip, or that a tie in depth may bring there.
struct alignas(64) Entry {
    double alpha[DOUBLES], low[DOUBLES], high[DOUBLES];
    double left[DOUBLES];  // the largest transmittance before it in float32, in any order of ties; 0: not listed
    double stop[DOUBLES];  // the same where float32 may end the pixel here and float64 goes on, else 0
    double jump[DOUBLES];  // if `tied`: what another order of equal depths changes, over all channels
    double nearest;        // the smallest `near` of it and all entries behind it
    const Listed* of;
    const Paint* paint;  // [D]
    bool tied, stops;    // stops: in some pixel
    // Bits of pixels: where it is listed; where float64 has ended the pixel; where float32 has ended it too, but a tie
    // may bring the Gaussian before the end.
    uint8_t listed, ended, behind;
};

// The memory of a thread, with room for the longest list of a tile, and of [D, DOUBLES] for the pixels of a strip.
struct Scratch {
    Entry* entries;
    Entry** members;
    double* nearest;
    double *image, *sums, *total, *behind, *rest;
};

// D channels; D = 0 means the number of channels in the arguments.
template <class Profile, int D>
class Strip {
public:
    Strip(const ExactArgs& a, const Scratch& s, int left, int top)
        : a(a), s(s), channels(D ? D : a.D), left(left), top(top), x(Doubles::load(STRIP_COLUMN) + (left + 0.5)),
          y(Doubles::load(STRIP_ROW) + (top + 0.5)),
          outside(!((x < Doubles(a.width)) & (y < Doubles(a.height)))) {}

    // Blends the `count` Gaussians of the tile that `places` lists, and writes the results of all pixels.
    void run(const Listed* tile, const Paint* paints, const int32_t* places, int64_t count, const ExactPicture& out) {
        for (int k = 0; k < channels; ++k) {
            for (double* sums : {s.image, s.sums, s.total}) Doubles(0.0).store(sums + k * DOUBLES);
        }
        front_to_back(tile, paints, places, count);
        ties();
        const Doubles culprit = back_to_front();
        write(culprit, out);
    }

private:
    const ExactArgs& a;
    const Scratch s;
    const int channels, left, top;
    const Doubles x, y;
    const DoubleMask outside;
    int64_t listed = 0;                                   // entries
    alignas(64) double left_most[DOUBLES];                // transmittance behind the last Gaussian, at most
    alignas(64) double loose[DOUBLES];                    // of all errors of alpha, on which the order acts too
    uint32_t skipped = 0, stopped = 0, ordered = 0;       // bits of pixels

    GSB_HD Shown show(const Listed& g) const {
        const Doubles least_seen(ALPHA_MIN), most_seen(ALPHA_MAX), zero(0.0);
        const Falloff<Doubles, Profile> exact(x - g.exact.x, y - g.exact.y, g.exact);
        const ExactOffset<Doubles> offset(g.single, x, y);
        const Doubles alpha = min(exact.free, MOST_ALPHA), power = exact.w * exact.w + exact.u * exact.u;
        const Interval<Doubles> free = SingleFalloff<Profile>::at(g.single, offset, power, exact.free, g.opacity_ratio);
        const Doubles high = min(free.high, most_seen), low = min(free.low, most_seen);
        const DoubleMask blends = alpha >= CameraOf<double>::LEAST_ALPHA, may = high >= least_seen;
        const DoubleMask must = (low >= least_seen) & (offset.power <= g.sure);
        return {select(blends, alpha, zero), select(must, low, zero), select(may, high, zero),
                (blends & !must) | (may & !blends) | (may & !must)};
    }

    // Blends the exact image, and lists what float64 or float32 blends until both have ended the pixels.
    void front_to_back(const Listed* tile, const Paint* paints, const int32_t* places, int64_t count) {
        const Doubles zero(0.0), least_single(TRANSMITTANCE_MIN);
        Doubles left(1.0), most_left(1.0), least_left(1.0), far(-1.0), errors(1.0);
        DoubleMask ended = outside, finished = outside;
        for (int64_t i = 0; i < count; ++i) {
            const Listed& g = tile[places[i]];
            if (!any(!finished | (far >= g.nearest))) break;
            const Shown c = show(g);
            const DoubleMask here = ((c.alpha > zero) | (c.high > zero)) & (!finished | (far >= g.near));
            if (!any(here)) continue;
            far = select(here, max(far, g.far), far);
            const DoubleMask runs = here & !finished, drawn = runs & (c.alpha > zero);
            ended = ended | (drawn & (left * (Doubles(1.0) - c.alpha) < LEAST_LEFT));
            const Doubles after_most = most_left * (Doubles(1.0) - c.low) + most_left * (2 * U);
            const Doubles after_least = max(least_left * (Doubles(1.0) - c.high) - least_left * (2 * U), zero);
            const DoubleMask finishes = runs & ended & (c.low > zero) & (after_most < least_single);
            const DoubleMask blended = runs & !finishes;
            const DoubleMask may_stop = blended & (c.high > zero) & (after_least < least_single);
            skipped |= bits(blended & c.undecided);
            stopped |= bits((blended & ended) | may_stop);

            Entry& entry = s.entries[listed++];
            entry.of = &g;
            entry.paint = paints + places[i] * channels;
            entry.tied = false;
            entry.stops = any(may_stop & !ended);
            entry.listed = static_cast<uint8_t>(bits(here));
            entry.ended = static_cast<uint8_t>(bits(here & (ended | !blended)));
            entry.behind = static_cast<uint8_t>(bits(here & finished));
            const Doubles alpha = select(blended & !ended, c.alpha, zero);
            const Doubles low = select(blended, c.low, zero), high = select(blended, c.high, zero);
            alpha.store(entry.alpha);
            low.store(entry.low);
            high.store(entry.high);
            select(here, most_left, zero).store(entry.left);
            select(may_stop & !ended, most_left, zero).store(entry.stop);
            errors += high - low;
            const Doubles weight = left * alpha, size = most_left * high;
            for (int k = 0; k < channels; ++k) {
                double *image = s.image + k * DOUBLES, *sum = s.sums + k * DOUBLES;
                (Doubles::load(image) + weight * entry.paint[k].color).store(image);
                (Doubles::load(sum) + size * entry.paint[k].size).store(sum);
            }
            left = left * (Doubles(1.0) - alpha);
            most_left = select(blended, min(after_most, most_left), most_left);
            least_left = select(blended, after_least, least_left);
            finished = finished | finishes;
        }
        for (int k = 0; k < channels; ++k) {
            double* image = s.image + k * DOUBLES;
            (Doubles::load(image) + left * a.background[k]).store(image);
        }
        most_left.store(left_most);
        errors.store(loose);
    }

    // Sums the largest changes of the pixels, with the exact colour behind each Gaussian. Returns the Gaussian with the
    // largest share of the bound in each pixel; -1: none.
    Doubles back_to_front() {
        Doubles culprit(-1.0), largest(-1.0);
        for (int k = 0; k < channels; ++k) {
            Doubles(a.background[k]).store(s.behind + k * DOUBLES);
            Doubles::load(s.sums + k * DOUBLES).store(s.rest + k * DOUBLES);
        }
        for (int64_t i = listed - 1; i >= 0; --i) {
            const Entry& e = s.entries[i];
            const Doubles alpha = Doubles::load(e.alpha), high = Doubles::load(e.high), left = Doubles::load(e.left);
            const DoubleMask here = left > 0.0;
            const Doubles pass = Doubles(1.0) - alpha, blended = left * high, rounds = left * (2.01 * U);
            const Doubles change = max(high - alpha, alpha - Doubles::load(e.low)) * left;
            const Doubles unit = select(here, Doubles(U), 0.0);
            Doubles share = e.tied ? Doubles::load(e.jump) : Doubles(0.0);
            for (int k = 0; k < channels; ++k) {
                const Paint& paint = e.paint[k];
                double *behind_at = s.behind + k * DOUBLES, *rest_at = s.rest + k * DOUBLES;
                double* total = s.total + k * DOUBLES;
                const Doubles behind = Doubles::load(behind_at), rest = Doubles::load(rest_at);
                const Doubles shown = alpha * paint.color + pass * behind;
                Doubles term = change * abs(behind - paint.color) + blended * paint.rate;
                term += rounds * abs(behind) + rest * unit;
                if (e.stops) term += Doubles::load(e.stop) * abs(shown - a.background[k]);
                shown.store(behind_at);
                (rest - blended * paint.size).store(rest_at);
                (Doubles::load(total) + term).store(total);
                share += term;
            }
            const DoubleMask larger = here & (share >= largest);
            largest = select(larger, share, largest);
            culprit = select(larger, static_cast<double>(e.of->id), culprit);
        }
        return culprit;
    }

    void write(Doubles culprits, const ExactPicture& out) const {
        alignas(64) double bound[DOUBLES], culprit[DOUBLES];
        Doubles largest(0.0);
        for (int k = 0; k < channels; ++k) {
            const Doubles sums = Doubles::load(s.sums + k * DOUBLES);
            const double behind = magnitude(a.background[k]);
            const Doubles last = (sums + Doubles::load(left_most) * (3 * behind)) * U;
            const Doubles noise = (sums + behind) * (NOISE * static_cast<double>(listed + 4));
            largest = max(largest, (Doubles::load(s.total + k * DOUBLES) + last) * 1.00001 + noise);
        }
        largest.store(bound);
        culprits.store(culprit);
        for (uint32_t inside = bits(!outside); inside; inside &= inside - 1) {
            const int lane = __builtin_ctz(inside);
            const int64_t at = static_cast<int64_t>(top + lane / STRIP_WIDTH) * a.width + left + lane % STRIP_WIDTH;
            for (int k = 0; k < channels; ++k) out.image[at * channels + k] = s.image[k * DOUBLES + lane];
            out.bound[at] = bound[lane];
            out.culprit[at] = static_cast<int32_t>(culprit[lane]);
            out.branches[at] = static_cast<uint8_t>((skipped >> lane & 1) * SKIPPED + (stopped >> lane & 1) * STOPPED +
                                                    (ordered >> lane & 1) * ORDERED);
        }
    }

    // Adds what the order of Gaussians can change whose depths are equal within their errors in float32.
    void ties() {
        for (int64_t i = listed - 1; i >= 0; --i) {
            Entry& e = s.entries[i];
            e.nearest = i + 1 < listed ? least(e.of->near, s.entries[i + 1].nearest) : e.of->near;
        }
        int64_t first = 0;
        while (first < listed) {
            double far = s.entries[first].of->far;
            int64_t end = first + 1;
            while (end < listed && s.entries[end].nearest <= far) far = most(far, s.entries[end++].of->far);
            if (end - first > 1) {
                for (int64_t i = first; i < end; ++i) {
                    s.entries[i].tied = true;
                    Doubles(0.0).store(s.entries[i].jump);
                }
                for (int lane = 0; lane < DOUBLES; ++lane) ties_at(lane, first, end);
            }
            first = end;
        }
    }

    // The same at one pixel, of entries of which some are listed there.
    void ties_at(int lane, int64_t first, int64_t end) {
        int64_t count = 0;
        for (int64_t i = first; i < end; ++i) {
            if (s.entries[i].listed >> lane & 1) s.members[count++] = &s.entries[i];
        }
        for (int64_t i = count - 1; i >= 0; --i) {
            const double near = s.members[i]->of->near;
            s.nearest[i] = i + 1 < count ? least(near, s.nearest[i + 1]) : near;
        }
        int64_t at = 0;
        while (at < count) {
            double far = s.members[at]->of->far;
            int64_t stop = at + 1;
            while (stop < count && s.nearest[stop] <= far) far = most(far, s.members[stop++]->of->far);
            if (stop - at > 1) {
                if (!(s.members[at]->behind >> lane & 1)) group(lane, s.members + at, stop - at);
                leave(lane, s.members + at, stop - at);
            }
            at = stop;
        }
    }

    // Lets each Gaussian of a group have the transmittance before the group.
    void leave(int lane, Entry* const* members, int64_t count) const {
        const double left = members[0]->left[lane];
        for (int64_t i = 1; i < count; ++i) {
            Entry& e = *members[i];
            const double more = (left - e.left[lane]) * e.high[lane];
            for (int k = 0; k < channels; ++k) {
                s.sums[k * DOUBLES + lane] += more * e.paint[k].size;
            }
            e.left[lane] = left;
            if (e.stop[lane] > 0) e.stop[lane] = left;
        }
    }

    void group(int lane, Entry* const* members, int64_t count) {
        ordered |= 1u << lane;
        bool stops = false;
        for (int64_t i = 0; i < count; ++i) {
            stops |= members[i]->stop[lane] > 0 || members[i]->ended >> lane & 1;
        }
        const double left = members[0]->left[lane] * loose[lane];
        if (!stops && count <= PAIRWISE) {
            // Another order is reached by swaps of neighbours, each pair at most once.
            for (int64_t j = 0; j < count; ++j) {
                for (int64_t i = 0; i < j; ++i) swap(lane, *members[i], *members[j], left);
            }
            return;
        }
        double pass = 1;
        for (int64_t i = 0; i < count; ++i) pass *= 1 - most(members[i]->high[lane], members[i]->alpha[lane]);
        for (int k = 0; k < channels; ++k) {
            double low = stops ? a.background[k] : members[0]->paint[k].color, high = low;
            for (int64_t i = 0; i < count; ++i) {
                const double color = members[i]->paint[k].color, error = members[i]->paint[k].error;
                low = least(low, color - error);
                high = most(high, color + error);
            }
            jump(lane, *members[0], k, left * (stops ? 1 : 1 - pass) * (high - low));
        }
    }

    void swap(int lane, const Entry& i, Entry& j, double left) const {
        if (i.of->far < j.of->near) return;  // they are tied by others between them, but keep their order
        const double both = left * most(i.high[lane], i.alpha[lane]) * most(j.high[lane], j.alpha[lane]);
        for (int k = 0; k < channels; ++k) {
            const double difference = magnitude(i.paint[k].color - j.paint[k].color);
            jump(lane, j, k, both * (difference + i.paint[k].error + j.paint[k].error));
        }
    }

    void jump(int lane, Entry& e, int channel, double size) const {
        s.total[channel * DOUBLES + lane] += size;
        e.jump[lane] += size;
    }
};

}  // namespace GSB_ISA
}  // namespace gsb
