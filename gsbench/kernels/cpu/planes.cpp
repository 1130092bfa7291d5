// Samples of planes of features, multiplied with each other, and their gradients.
//
// All points of a view share its time, so planes of time are lines to them.
// A plane's node has C channels side by side. Channels do not meet before a gradient by a position, so in the backward
// pass a thread takes sixteen channels of a level, for all points in order: the bits do not depend on the threads.
#include "buffer.h"
#include "isa.h"
#include "rows.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int64_t CHUNK = 32;  // points whose nodes are fetched before they are read
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

// One level of planes: the nodes along each axis, and where the nodes of each plane of space, of each plane of time and
// of each line begin. A line is a plane of time at the time of the view.
struct Level {
    int nodes[AXES];
    int64_t in_space[PLANES], in_time[AXES], in_lines[AXES];
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
                of.in_time[axis] = nodes_of_lines * a.t;
                nodes_of_lines += along[axis];
            }
            for (int k = 0; k < PLANES; ++k) {
                of.in_space[k] = space;
                space += int64_t{along[COLUMN[k]]} * along[ROW[k]];
            }
        }
    }
};

// Calls f(n, before, after, line) for the channels of all lines, n from each of these addresses on: `before` and `after`
// are those of the nodes of `planes` that lie before and after the time.
template <class Float, class F>
void for_each_line(const PlaneArgs& a, const Levels& levels, const Place& time, Float* planes, float* lines, F f) {
    for (int l = 0; l < a.levels; ++l) {
        const Level& level = levels.level[l];
        for (int axis = 0; axis < AXES; ++axis) {
            const int64_t size = int64_t{level.nodes[axis]} * a.C;  // of a row of the plane
            Float* before = planes + level.in_time[axis] * a.C + time.node * size;
            float* line = lines + level.in_lines[axis] * a.C;
            for (int64_t c = 0; c < size; c += LANES) {
                f(lanes_from(c, size), before + c, before + size + c, line + c);
            }
        }
    }
}

// Writes the planes of time at the time of the view to `lines`.
void find_lines(const PlaneArgs& a, const Levels& levels, const Place& time, float* lines) {
    const Vec share(time.share);
    for_each_line(a, levels, time, a.of_time, lines, [&](int n, const float* before, const float* after, float* line) {
        const Vec first = load_some(before, n);
        store_first(first + share * (load_some(after, n) - first), line, n);
    });
}

// Where a point lies in the planes and lines of a level: the first channel of the first node of its cell, and the places
// along the axes.
struct Cells {
    int64_t in_space[PLANES], row[PLANES], in_lines[AXES];  // row: the distance to the next row
    Place at[AXES];
};

// Writes the cells of point i in a level to `cells`, and fetches so many channels, from `channel` on, of the nodes in
// space and of the array `also`, if there is one.
GSB_HD inline void find_cells(const PlaneArgs& a, const Level& level, int64_t i, int channel, int channels, Cells& cells,
                              const float* also) {
    for (int axis = 0; axis < AXES; ++axis) {
        const float from_first = a.positions[3 * i + axis] - a.first[axis];
        const float coordinate = from_first * 2.0f / (a.last[axis] - a.first[axis]) - 1.0f;
        cells.at[axis] = place_of(coordinate, level.nodes[axis]);
        cells.in_lines[axis] = (level.in_lines[axis] + cells.at[axis].node) * a.C;
    }
    for (int k = 0; k < PLANES; ++k) {
        const int64_t width = level.nodes[COLUMN[k]];
        const int64_t first = (level.in_space[k] + cells.at[ROW[k]].node * width + cells.at[COLUMN[k]].node) * a.C;
        cells.in_space[k] = first;
        cells.row[k] = width * a.C;
        for (int corner = 0; corner < 4; ++corner) {
            const int64_t node = first + channel + (corner % 2 + corner / 2 * width) * a.C;
            for (int c = 0; c < channels; c += LANES) {
                __builtin_prefetch(a.of_space + node + c);
                if (also) __builtin_prefetch(also + node + c, 1);
            }
        }
    }
}

// A sample of a plane, and its derivatives along columns and rows; one of a line has the first alone.
struct Sample {
    Vec value, along, across;
};

GSB_HD inline Sample sample(const float* p, int64_t next, int64_t row, const Place& column, const Place& in_row, int n) {
    const Vec a = load_some(p, n), b = load_some(p + next, n) - a;
    const Vec c = load_some(p + row, n), d = load_some(p + row + next, n) - c;
    const Vec top = a + Vec(column.share) * b, bottom = c + Vec(column.share) * d, across = bottom - top;
    return {top + Vec(in_row.share) * across, b + Vec(in_row.share) * (d - b), across};
}

GSB_HD inline Sample sample_line(const float* p, int64_t next, const Place& place, int n) {
    const Vec a = load_some(p, n), b = load_some(p + next, n) - a;
    return {a + Vec(place.share) * b, b, Vec(0.0f)};
}

// Writes the samples of all planes and lines of a level at a point, of the n channels from `channel` on.
GSB_HD inline void sample_all(const PlaneArgs& a, const float* lines, const Cells& cells, int channel, int n,
                              Sample (&planes)[PLANES], Sample (&at_lines)[AXES]) {
    for (int k = 0; k < PLANES; ++k) {
        planes[k] = sample(a.of_space + cells.in_space[k] + channel, a.C, cells.row[k], cells.at[COLUMN[k]],
                           cells.at[ROW[k]], n);
    }
    for (int axis = 0; axis < AXES; ++axis) {
        at_lines[axis] = sample_line(lines + cells.in_lines[axis] + channel, a.C, cells.at[axis], n);
    }
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

GSB_HD inline void add_cell(Vec g, float* p, int64_t next, int64_t row, const Place& column, const Place& in_row, int n) {
    const Vec bottom = g * Vec(in_row.share);
    add_pair(g - bottom, column.share, p, next, n);
    add_pair(bottom, column.share, p + row, next, n);
}

// A plane and its weights in the penalty: its first number, its rows, the numbers in a row, and whether it is of time.
struct Plane {
    int64_t first, rows, size;
    bool in_time;

    float smoothness(const PenaltyArgs& a) const {  // of the sum of squares
        const float weight = in_time ? a.time_smoothness : a.space_smoothness;
        return rows > 2 ? weight / static_cast<float>((rows - 2) * size) : 0.0f;
    }
    float sparsity(const PenaltyArgs& a) const {  // of the sum of distances from 1
        return in_time ? a.time_sparsity / static_cast<float>(rows * size) : 0.0f;
    }
};

template <class F>
void for_each_plane(const PenaltyArgs& a, F f) {
    const Levels levels(a);
    for (int l = 0; l < a.levels; ++l) {
        const Level& level = levels.level[l];
        for (int k = 0; k < PLANES; ++k) {
            f(Plane{level.in_space[k] * a.C, level.nodes[ROW[k]], int64_t{level.nodes[COLUMN[k]]} * a.C, false});
        }
        for (int axis = 0; axis < AXES; ++axis) {
            f(Plane{level.in_time[axis] * a.C, a.t, int64_t{level.nodes[axis]} * a.C, true});
        }
    }
}

// Returns the second difference along the rows at n numbers p of row r, or zero in the first and the last row.
GSB_HD inline Vec bend(const Plane& plane, int64_t r, const float* p, int n) {
    if (r < 1 || r > plane.rows - 2) return Vec(0.0f);
    const Vec here = load_some(p, n);
    return (load_some(p + plane.size, n) - here) - (here - load_some(p - plane.size, n));
}

// Returns 1 - p for n numbers, and zero in the other lanes.
GSB_HD inline Vec below_one(const float* p, int n) {
    alignas(64) constexpr float ones[LANES] = {1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1};
    return load_some(ones, n) - load_some(p, n);
}

}  // namespace

void sample_planes(const PlaneArgs& a, const Features& out) {
    const Levels levels(a);
    Buffer<float> lines(static_cast<size_t>(levels.nodes_of_lines * a.C));
    find_lines(a, levels, place_of(*a.time, a.t), lines.data());
    const int64_t F = int64_t{a.levels} * a.C;
#pragma omp parallel for num_threads(a.threads) schedule(dynamic, 8) if (a.N > CHUNK)
    for (int64_t first = 0; first < a.N; first += CHUNK) {
        const int64_t count = a.N - first < CHUNK ? a.N - first : CHUNK;
        Cells cells[CHUNK];
        for (int l = 0; l < a.levels; ++l) {
            for (int64_t i = 0; i < count; ++i) {
                find_cells(a, levels.level[l], first + i, 0, a.C, cells[i], nullptr);
            }
            for (int64_t i = 0; i < count; ++i) {
                for (int c = 0; c < a.C; c += LANES) {
                    const int n = lanes_from(c, a.C);
                    Sample in_space[PLANES], in_time[AXES];
                    sample_all(a, lines.data(), cells[i], c, n, in_space, in_time);
                    store_first(product_of(in_space) * product_of(in_time), out.features + (first + i) * F + l * a.C + c,
                                n);
                }
            }
        }
    }
}

void sample_planes_backward(const PlaneArgs& a, const FeatureGrads& grads, const PlaneGrads& out) {
    const Levels levels(a);
    const Place time = place_of(*a.time, a.t);
    const size_t in_lines = static_cast<size_t>(levels.nodes_of_lines * a.C);
    Buffer<float> lines(in_lines), g_lines(in_lines);
    find_lines(a, levels, time, lines.data());
    g_lines.zero();
    const int64_t F = int64_t{a.levels} * a.C;
    const int parts = (a.C + LANES - 1) / LANES, tasks = a.levels * parts;
    Buffer<float> moved(static_cast<size_t>(int64_t{tasks} * a.N * 4));  // of each task, gradients by x, y and z
#pragma omp parallel for num_threads(a.threads) schedule(dynamic, 1) if (a.N > CHUNK)
    for (int task = 0; task < tasks; ++task) {
        const int l = task / parts, c = task % parts * LANES, n = lanes_from(c, a.C);
        const float* given = grads.features + l * a.C + c;
        float* by_axis = moved.data() + int64_t{task} * a.N * 4;
        for (int64_t first = 0; first < a.N; first += CHUNK) {
            const int64_t count = a.N - first < CHUNK ? a.N - first : CHUNK;
            Cells all[CHUNK];
            for (int64_t i = 0; i < count; ++i) {
                find_cells(a, levels.level[l], first + i, c, n, all[i], out.of_space);
                __builtin_prefetch(given + (first + i) * F);
            }
            for (int64_t i = 0; i < count; ++i) {
                const Cells& cells = all[i];
                const Vec g = load_some(given + (first + i) * F, n);
                if (bits(g == Vec(0.0f)) == ALL_LANES) {  // as of a Gaussian behind others
                    fill_zero(by_axis, 4, first + i, first + i + 1);
                    continue;
                }
                Sample in_space[PLANES], in_time[AXES];
                sample_all(a, lines.data(), cells, c, n, in_space, in_time);
                Vec by_planes[PLANES], by_lines[AXES];
                by_factors(g * product_of(in_time), in_space, by_planes);
                by_factors(g * product_of(in_space), in_time, by_lines);
                Vec by[AXES];
                for (int axis = 0; axis < AXES; ++axis) {
                    const Place& at = cells.at[axis];
                    add_pair(by_lines[axis], at.share, g_lines.data() + cells.in_lines[axis] + c, a.C, n);
                    by[axis] = by_lines[axis] * in_time[axis].along;
                }
                for (int k = 0; k < PLANES; ++k) {
                    add_cell(by_planes[k], out.of_space + cells.in_space[k] + c, a.C, cells.row[k], cells.at[COLUMN[k]],
                             cells.at[ROW[k]], n);
                    by[COLUMN[k]] += by_planes[k] * in_space[k].along;
                    by[ROW[k]] += by_planes[k] * in_space[k].across;
                }
                for (int axis = 0; axis < AXES; ++axis) by[axis] = by[axis] * Vec(cells.at[axis].slope);
                sum4(by[0], by[1], by[2], Vec(0.0f), by_axis + (first + i) * 4);
            }
        }
    }
    for_each_line(a, levels, time, out.of_time, g_lines.data(), [&](int n, float* before, float* after, float* line) {
        const Vec g = load_some(line, n), later = g * Vec(time.share);
        store_first(g - later, before, n);
        store_first(later, after, n);
    });
#pragma omp parallel for num_threads(a.threads) schedule(static) if (a.N > CHUNK)
    for (int64_t i = 0; i < a.N; ++i) {
        for (int axis = 0; axis < AXES; ++axis) {
            float sum = 0.0f;
            for (int task = 0; task < tasks; ++task) sum += moved[static_cast<size_t>((task * a.N + i) * 4 + axis)];
            out.positions[3 * i + axis] = sum * 2.0f / (a.last[axis] - a.first[axis]);
        }
    }
}

void plane_penalty(const PenaltyArgs& a, const Penalty& out) {
    double total = 0.0;
    for_each_plane(a, [&](const Plane& plane) {
        const float* nodes = (plane.in_time ? a.of_time : a.of_space) + plane.first;
        Buffer<float> of_rows(static_cast<size_t>(plane.rows));
#pragma omp parallel for num_threads(a.threads) schedule(static)
        for (int64_t r = 0; r < plane.rows; ++r) {
            Vec squares(0.0f), distances(0.0f);
            for (int64_t c = 0; c < plane.size; c += LANES) {
                const int n = lanes_from(c, plane.size);
                const float* p = nodes + r * plane.size + c;
                const Vec x = bend(plane, r, p, n), below = below_one(p, n);
                squares += x * x;
                if (plane.in_time) distances += max(below, -below);
            }
            of_rows[static_cast<size_t>(r)] = plane.smoothness(a) * sum(squares) + plane.sparsity(a) * sum(distances);
        }
        for (int64_t r = 0; r < plane.rows; ++r) total += static_cast<double>(of_rows[static_cast<size_t>(r)]);
    });
    *out.penalty = static_cast<float>(total);
}

void plane_penalty_backward(const PenaltyArgs& a, const PenaltyGrad& grad, const NodeGrads& out) {
    for_each_plane(a, [&](const Plane& plane) {
        const float* nodes = (plane.in_time ? a.of_time : a.of_space) + plane.first;
        float* g = (plane.in_time ? out.of_time : out.of_space) + plane.first;
        const Vec by_bend(2.0f * plane.smoothness(a) * *grad.penalty), by_distance(plane.sparsity(a) * *grad.penalty);
#pragma omp parallel for num_threads(a.threads) schedule(static)
        for (int64_t r = 0; r < plane.rows; ++r) {
            for (int64_t c = 0; c < plane.size; c += LANES) {
                const int n = lanes_from(c, plane.size);
                const float* p = nodes + r * plane.size + c;
                const Vec here = bend(plane, r, p, n), below = below_one(p, n);
                const Vec before = bend(plane, r - 1, p - plane.size, n), after = bend(plane, r + 1, p + plane.size, n);
                Vec x = by_bend * ((before - here) + (after - here));
                if (plane.in_time) {
                    const Vec down = select(below > Vec(0.0f), by_distance, Vec(0.0f));
                    x += select(below < Vec(0.0f), by_distance, Vec(0.0f)) - down;
                }
                store_first(x, g + r * plane.size + c, n);
            }
        }
    });
}

}  // namespace GSB_ISA
}  // namespace gsb
