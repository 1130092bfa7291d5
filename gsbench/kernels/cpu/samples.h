// Levels of planes of features over two of the axes x, y, z or over one of them and time, where points lie in them, and
// products of samples.
#pragma once

#include <cstdint>

#include "kernels.h"
#include "rows.h"

namespace gsb {
inline namespace GSB_ISA {

constexpr int AXES = 3, PLANES = 3;                                // x, y, z; of space in a level
constexpr int COLUMN[PLANES] = {0, 0, 1}, ROW[PLANES] = {1, 2, 2};  // the axis along each

// Where a coordinate lies: after which node, at which share of the way to the next one, and how that share changes with
// the coordinate, which is not at all beyond the border.
struct Place {
    int64_t node;
    float share, slope;
};

GSB_HD inline Place place_of(float coordinate, int nodes) {
    const float last = static_cast<float>(nodes - 1), at = (coordinate + 1.0f) * 0.5f * last;
    const bool inside = at > 0.0f && at < last;  // NaN lies at the first node
    const float bounded = inside ? at : at > 0.0f ? last : 0.0f;
    const int64_t node = static_cast<int64_t>(bounded), most = nodes - 2;
    const int64_t before = node < most ? node : most;
    return {before, bounded - static_cast<float>(before), inside ? 0.5f * last : 0.0f};
}

// One level of planes: the nodes along each axis, and where the nodes of each plane of space and of each line begin. A
// line is a plane of time at one time; the planes of time begin at so many times the nodes of the lines before.
struct Level {
    int nodes[AXES];
    int64_t in_space[PLANES], in_lines[AXES];
};

struct Levels {
    Level level[MOST_LEVELS];
    int64_t nodes_of_lines = 0;

    template <class Args>
    explicit Levels(const Args& a) {
        int64_t space = 0;
        for (int l = 0; l < a.levels; ++l) {
            Level& of = level[l];
            const int along[AXES] = {a.x << l, a.y << l, a.z << l};
            for (int axis = 0; axis < AXES; ++axis) {
                of.nodes[axis] = along[axis];
                of.in_lines[axis] = nodes_of_lines;
                nodes_of_lines += along[axis];
            }
            for (int k = 0; k < PLANES; ++k) {
                of.in_space[k] = space;
                space += int64_t{along[COLUMN[k]]} * along[ROW[k]];
            }
        }
    }
};

// Writes the places of point i along the axes of a level.
template <class Args>
GSB_HD inline void find_places(const Args& a, const Level& level, int64_t i, Place (&at)[AXES]) {
    for (int axis = 0; axis < AXES; ++axis) {
        const float from_first = a.positions[3 * i + axis] - a.first[axis];
        const float coordinate = from_first * 2.0f / (a.last[axis] - a.first[axis]) - 1.0f;
        at[axis] = place_of(coordinate, level.nodes[axis]);
    }
}

// A sample of a plane, and its derivatives along columns and rows; one of a line has the first alone.
struct Sample {
    Vec value, along, across;
};

GSB_HD inline Sample sample_line(const float* p, int64_t next, const Place& place, int n) {
    const Vec a = load_some(p, n), b = load_some(p + next, n) - a;
    return {a + Vec(place.share) * b, b, Vec(0.0f)};
}

GSB_HD inline Vec product_of(const Sample (&x)[3]) { return Vec(x[0].value * x[1].value) * x[2].value; }

// Writes g times the product of the other two values for each of three samples.
GSB_HD inline void by_factors(Vec g, const Sample (&x)[3], Vec (&out)[3]) {
    const Vec by_two = g * x[2].value;
    out[0] = by_two * x[1].value;
    out[1] = by_two * x[0].value;
    out[2] = g * Vec(x[0].value * x[1].value);
}

GSB_HD inline void add_pair(Vec g, float share, float* p, int64_t next, int n) {
    const Vec right = g * Vec(share);
    add_first(g - right, p, n);
    add_first(right, p + next, n);
}

}  // namespace GSB_ISA
}  // namespace gsb
