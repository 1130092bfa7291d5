// Samples of planes of features, multiplied with each other, and their gradients.
//
// A plane's node has C channels side by side. Channels do not meet before a gradient by a position, so in the backward
// pass a thread takes sixteen channels of a level, for all points in order: the bits do not depend on the threads.
#include "buffer.h"
#include "isa.h"
#include "rows.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int64_t CHUNK = 32;  // points whose nodes are fetched before they are read
constexpr int PLANES = 3;      // of space or of time in a level
constexpr int AXES = 4;        // x, y, z, t
constexpr int COLUMN[2][PLANES] = {{0, 0, 1}, {0, 1, 2}}, ROW[2][PLANES] = {{1, 2, 2}, {3, 3, 3}};  // the axis along each

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

// The cell of a plane that a point lies in: the first channel of its first node, the distance to the next row.
struct Cell {
    int64_t first, row;
    Place along, across;  // the columns, the rows
};

// One level of planes, and where its nodes begin.
struct Level {
    int nodes[AXES];
    int64_t first[PLANES];
};

// Writes the levels to `out` and returns of which kind they are: 0 of space, 1 of time.
int describe(const PlaneArgs& a, Level* out) {
    const int kind = a.time ? 1 : 0;
    int64_t first = 0;
    for (int level = 0; level < a.levels; ++level) {
        Level& of = out[level];
        const int along[AXES] = {a.x << level, a.y << level, a.z << level, a.t};
        for (int axis = 0; axis < AXES; ++axis) of.nodes[axis] = along[axis];
        for (int k = 0; k < PLANES; ++k) {
            of.first[k] = first;
            first += int64_t{along[COLUMN[kind][k]]} * along[ROW[kind][k]];
        }
    }
    return kind;
}

// Writes the cells of point i in a level to `cells`, and fetches so many channels, from `channel` on, of their nodes and
// of the array `also`, if there is one.
GSB_HD inline void find_cells(const PlaneArgs& a, const Level& level, int kind, int64_t i, int channel, int channels,
                              Cell (&cells)[PLANES], const float* also) {
    Place places[AXES];
    for (int axis = 0; axis < 3; ++axis) places[axis] = place_of(a.coordinates[3 * i + axis], level.nodes[axis]);
    if (kind) places[3] = place_of(*a.time, level.nodes[3]);
    for (int k = 0; k < PLANES; ++k) {
        const int column = COLUMN[kind][k], row = ROW[kind][k];
        const int64_t width = level.nodes[column];
        const int64_t first = (level.first[k] + places[row].node * width + places[column].node) * a.C + channel;
        cells[k] = {first, width * a.C, places[column], places[row]};
        for (int corner = 0; corner < 4; ++corner) {
            const int64_t node = first + (corner % 2 + corner / 2 * width) * a.C;
            for (int c = 0; c < channels; c += LANES) {
                __builtin_prefetch(a.nodes + node + c);
                if (also) __builtin_prefetch(also + node + c, 1);
            }
        }
    }
}

// A sample of a plane, and its derivatives along columns and rows.
struct Sample {
    Vec value, along, across;
};

GSB_HD inline Sample sample(const float* nodes, const Cell& cell, int64_t next, int n) {
    const float* p = nodes + cell.first;
    const Vec a = load_some(p, n), b = load_some(p + next, n) - a;
    const Vec c = load_some(p + cell.row, n), d = load_some(p + cell.row + next, n) - c;
    const Vec top = a + Vec(cell.along.share) * b, bottom = c + Vec(cell.along.share) * d, across = bottom - top;
    return {top + Vec(cell.across.share) * across, b + Vec(cell.across.share) * (d - b), across};
}

GSB_HD inline void add_sample(Vec g, float* nodes, const Cell& cell, int64_t next, int n) {
    float* p = nodes + cell.first;
    const Vec bottom = g * Vec(cell.across.share), top = g - bottom;
    const Vec right = top * Vec(cell.along.share), bottom_right = bottom * Vec(cell.along.share);
    add_first(top - right, p, n);
    add_first(right, p + next, n);
    add_first(bottom - bottom_right, p + cell.row, n);
    add_first(bottom_right, p + cell.row + next, n);
}

}  // namespace

void sample_planes(const PlaneArgs& a, const Features& out) {
    Level levels[MOST_LEVELS];
    const int kind = describe(a, levels);
    const int64_t F = int64_t{a.levels} * a.C;
#pragma omp parallel for num_threads(a.threads) schedule(dynamic, 8) if (a.N > CHUNK)
    for (int64_t first = 0; first < a.N; first += CHUNK) {
        const int64_t count = a.N - first < CHUNK ? a.N - first : CHUNK;
        Cell cells[CHUNK][PLANES];
        for (int l = 0; l < a.levels; ++l) {
            for (int64_t i = 0; i < count; ++i) find_cells(a, levels[l], kind, first + i, 0, a.C, cells[i], nullptr);
            for (int64_t i = 0; i < count; ++i) {
                for (int c = 0; c < a.C; c += LANES) {
                    const int n = a.C - c < LANES ? a.C - c : LANES;
                    const int64_t at = (first + i) * F + l * a.C + c;
                    Vec y = a.factors ? load_some(a.factors + at, n) : Vec(1.0f);
                    for (const Cell& cell : cells[i]) y = y * sample(a.nodes + c, cell, a.C, n).value;
                    store_first(y, out.features + at, n);
                }
            }
        }
    }
}

void sample_planes_backward(const PlaneArgs& a, const FeatureGrads& grads, const PlaneGrads& out) {
    Level levels[MOST_LEVELS];
    const int kind = describe(a, levels);
    const int64_t F = int64_t{a.levels} * a.C;
    const int parts = (a.C + LANES - 1) / LANES, tasks = a.levels * parts;
    Buffer<float> moved(static_cast<size_t>(int64_t{tasks} * a.N * AXES));  // of each task, gradients by x, y and z
#pragma omp parallel for num_threads(a.threads) schedule(dynamic, 1) if (a.N > CHUNK)
    for (int task = 0; task < tasks; ++task) {
        const int l = task / parts, c = task % parts * LANES, n = a.C - c < LANES ? a.C - c : LANES;
        float* by_axis = moved.data() + int64_t{task} * a.N * AXES;
        for (int64_t first = 0; first < a.N; first += CHUNK) {
            const int64_t count = a.N - first < CHUNK ? a.N - first : CHUNK;
            Cell cells[CHUNK][PLANES];
            for (int64_t i = 0; i < count; ++i) find_cells(a, levels[l], kind, first + i, c, n, cells[i], out.nodes);
            for (int64_t i = 0; i < count; ++i) {
                const int64_t at = (first + i) * F + l * a.C + c;
                const Vec g = load_some(grads.features + at, n);
                if (bits(g == Vec(0.0f)) == ALL_LANES) {  // as of a Gaussian behind others
                    if (a.factors) store_first(g, out.factors + at, n);
                    fill_zero(by_axis, AXES, first + i, first + i + 1);
                    continue;
                }
                const Vec factor = a.factors ? load_some(a.factors + at, n) : Vec(1.0f);
                Sample samples[PLANES];
                for (int k = 0; k < PLANES; ++k) samples[k] = sample(a.nodes, cells[i][k], a.C, n);
                const Vec first_two = samples[0].value * samples[1].value;
                if (a.factors) store_first(g * Vec(first_two * samples[2].value), out.factors + at, n);
                const Vec by_product = g * factor, by_two = by_product * samples[2].value;
                const Vec by_sample[PLANES] = {by_two * samples[1].value, by_two * samples[0].value, by_product * first_two};
                Vec by[AXES] = {Vec(0.0f), Vec(0.0f), Vec(0.0f), Vec(0.0f)};
                for (int k = 0; k < PLANES; ++k) {
                    const Cell& cell = cells[i][k];
                    add_sample(by_sample[k], out.nodes, cell, a.C, n);
                    by[COLUMN[kind][k]] += Vec(by_sample[k] * samples[k].along) * Vec(cell.along.slope);
                    by[ROW[kind][k]] += Vec(by_sample[k] * samples[k].across) * Vec(cell.across.slope);
                }
                sum4(by[0], by[1], by[2], by[3], by_axis + (first + i) * AXES);
            }
        }
    }
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N > CHUNK)
    for (int64_t i = 0; i < a.N; ++i) {
        for (int axis = 0; axis < 3; ++axis) {
            float sum = 0.0f;
            for (int task = 0; task < tasks; ++task) sum += moved[static_cast<size_t>((task * a.N + i) * AXES + axis)];
            out.coordinates[3 * i + axis] = sum;
        }
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
