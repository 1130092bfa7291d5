// Planes of time at the time of a view, which are lines to its points: features of points, and their gradients.
#pragma once

#include "buffer.h"
#include "kernels.h"
#include "samples.h"

namespace gsb {
inline namespace GSB_ISA {

struct Lines {
    Levels levels;
    Place time;
    int64_t size;  // numbers of all lines
    Buffer<float> nodes;

    explicit Lines(const FieldArgs& a)
        : levels(a), time(place_of(*a.time, a.t)), size(levels.nodes_of_lines * a.C), nodes(static_cast<size_t>(size)) {
        const Vec share(time.share);
        for_each(a, a.of_time, nodes.data(), [&](int n, const float* before, const float* after, float* line) {
            const Vec first = load_some(before, n);
            store_first(first + share * (load_some(after, n) - first), line, n);
        });
    }

    // Calls f(n, before, after, line) for the channels of all lines, n from each of these addresses on: `before` and
    // `after` are those of the nodes of `planes` that lie before and after the time.
    template <class Float, class F>
    void for_each(const FieldArgs& a, Float* planes, float* lines, F f) const {
        for (int l = 0; l < a.levels; ++l) {
            const Level& level = levels.level[l];
            for (int axis = 0; axis < AXES; ++axis) {
                const int64_t row = int64_t{level.nodes[axis]} * a.C;  // of the plane
                Float* before = planes + level.in_lines[axis] * a.t * a.C + time.node * row;
                float* line = lines + level.in_lines[axis] * a.C;
                for (int64_t c = 0; c < row; c += LANES) f(lanes_from(c, row), before + c, before + row + c, line + c);
            }
        }
    }

    // Calls f(feature, n, places, in_lines, samples) for n features from `feature` on, and so for all features of point
    // i: in_lines has for each axis the offset of the node before the point.
    template <class F>
    GSB_HD void sample(const FieldArgs& a, int64_t i, F f) {
        for (int l = 0; l < a.levels; ++l) {
            const Level& level = levels.level[l];
            Place at[AXES];
            find_places(a, level, i, at);
            for (int c = 0; c < a.C; c += LANES) {
                const int n = lanes_from(c, a.C);
                int64_t in_lines[AXES];
                Sample samples[AXES];
                GSB_UNROLL for (int axis = 0; axis < AXES; ++axis) {
                    in_lines[axis] = (level.in_lines[axis] + at[axis].node) * a.C + c;
                    samples[axis] = sample_line(nodes.data() + in_lines[axis], a.C, at[axis], n);
                }
                f(l * a.C + c, n, at, in_lines, samples);
            }
        }
    }

    // Writes the features of point i to x.
    void features(const FieldArgs& a, int64_t i, float* x) {
        const float* products = a.products + i * a.F;
        sample(a, i, [&](int feature, int n, const Place (&)[AXES], const int64_t (&)[AXES], const Sample (&samples)[AXES]) {
            store_first(load_some(products + feature, n) * product_of(samples), x + feature, n);
        });
    }

    // Adds the gradients of point i by its features, g_x, to those of products and positions, and to g_lines.
    void features_backward(const FieldArgs& a, int64_t i, const float* g_x, const FieldGrads& out, float* g_lines) {
        const float* products = a.products + i * a.F;
        Vec by_axis[AXES] = {Vec(0.0f), Vec(0.0f), Vec(0.0f)};
        sample(a, i, [&](int feature, int n, const Place (&at)[AXES], const int64_t (&in_lines)[AXES],
                         const Sample (&samples)[AXES]) {
            const Vec g = load_some(g_x + feature, n);
            add_first(g * product_of(samples), out.products + i * a.F + feature, n);
            Vec by_lines[AXES];
            by_factors(g * load_some(products + feature, n), samples, by_lines);
            GSB_UNROLL for (int axis = 0; axis < AXES; ++axis) {
                add_pair(by_lines[axis], at[axis].share, g_lines + in_lines[axis], a.C, n);
                by_axis[axis] += Vec(by_lines[axis] * samples[axis].along) * Vec(at[axis].slope);
            }
        });
        float by[4];
        sum4(by_axis[0], by_axis[1], by_axis[2], Vec(0.0f), by);
        for (int axis = 0; axis < AXES; ++axis) {
            out.positions[3 * i + axis] += by[axis] * 2.0f / (a.last[axis] - a.first[axis]);
        }
    }
};

}  // namespace GSB_ISA
}  // namespace gsb
