// Samples of planes of features over space, multiplied with each other, their gradients, and how rough all planes are.
//
// A plane's node has C channels side by side. Channels do not meet before a gradient by a position, so in the backward
// pass a thread takes sixteen channels of a level, for all points in order: the bits do not depend on the threads.
#include "buffer.h"
#include "isa.h"
#include "rows.h"
#include "samples.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int64_t CHUNK = 32;  // points whose nodes are fetched before they are read
// Where a point lies in the planes of a level: the first channel of the first node of its cell, and the places along
// the axes.
struct Cells {
    int64_t in_space[PLANES], row[PLANES];  // row: the distance to the next row
    Place at[AXES];
};

// Writes the cells of point i in a level to `cells`, and fetches so many channels, from `channel` on, of the nodes and
// of the array `also`, if there is one.
GSB_HD inline void find_cells(const PlaneArgs& a, const Level& level, int64_t i, int channel, int channels, Cells& cells,
                              const float* also) {
    find_places(a, level, i, cells.at);
    GSB_UNROLL for (int k = 0; k < PLANES; ++k) {
        const int64_t width = level.nodes[COLUMN[k]];
        const int64_t first = (level.in_space[k] + cells.at[ROW[k]].node * width + cells.at[COLUMN[k]].node) * a.C;
        cells.in_space[k] = first;
        cells.row[k] = width * a.C;
        GSB_UNROLL for (int corner = 0; corner < 4; ++corner) {
            const int64_t node = first + channel + (corner % 2 + corner / 2 * width) * a.C;
            for (int c = 0; c < channels; c += LANES) {
                __builtin_prefetch(a.of_space + node + c);
                if (also) __builtin_prefetch(also + node + c, 1);
            }
        }
    }
}

GSB_HD inline Sample sample(const float* p, int64_t next, int64_t row, const Place& column, const Place& in_row, int n) {
    const Vec a = load_some(p, n), b = load_some(p + next, n) - a;
    const Vec c = load_some(p + row, n), d = load_some(p + row + next, n) - c;
    const Vec top = a + Vec(column.share) * b, bottom = c + Vec(column.share) * d, across = bottom - top;
    return {top + Vec(in_row.share) * across, b + Vec(in_row.share) * (d - b), across};
}

// Writes the samples of all planes of a level at a point, of the n channels from `channel` on.
GSB_HD inline void sample_all(const PlaneArgs& a, const Cells& cells, int channel, int n, Sample (&planes)[PLANES]) {
    GSB_UNROLL for (int k = 0; k < PLANES; ++k) {
        planes[k] = sample(a.of_space + cells.in_space[k] + channel, a.C, cells.row[k], cells.at[COLUMN[k]],
                           cells.at[ROW[k]], n);
    }
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
            f(Plane{level.in_lines[axis] * a.t * a.C, a.t, int64_t{level.nodes[axis]} * a.C, true});
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

void sample_planes(const PlaneArgs& a, const Products& out) {
    const Levels levels(a);
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
                    Sample planes[PLANES];
                    sample_all(a, cells[i], c, n, planes);
                    store_first(product_of(planes), out.products + (first + i) * F + l * a.C + c, n);
                }
            }
        }
    }
}

void sample_planes_backward(const PlaneArgs& a, const ProductGrads& grads, const PlaneGrads& out) {
    const Levels levels(a);
    const int64_t F = int64_t{a.levels} * a.C;
    const int parts = (a.C + LANES - 1) / LANES, tasks = a.levels * parts;
    Buffer<float> moved(static_cast<size_t>(int64_t{tasks} * a.N * 4));  // of each task, gradients by x, y and z
#pragma omp parallel for num_threads(a.threads) schedule(dynamic, 1) if (a.N > CHUNK)
    for (int task = 0; task < tasks; ++task) {
        const int l = task / parts, c = task % parts * LANES, n = lanes_from(c, a.C);
        const float* given = grads.products + l * a.C + c;
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
                Sample planes[PLANES];
                sample_all(a, cells, c, n, planes);
                Vec by_planes[PLANES], by[AXES] = {Vec(0.0f), Vec(0.0f), Vec(0.0f)};
                by_factors(g, planes, by_planes);
                GSB_UNROLL for (int k = 0; k < PLANES; ++k) {
                    add_cell(by_planes[k], out.of_space + cells.in_space[k] + c, a.C, cells.row[k], cells.at[COLUMN[k]],
                             cells.at[ROW[k]], n);
                    by[COLUMN[k]] += by_planes[k] * planes[k].along;
                    by[ROW[k]] += by_planes[k] * planes[k].across;
                }
                GSB_UNROLL for (int axis = 0; axis < AXES; ++axis) by[axis] = by[axis] * Vec(cells.at[axis].slope);
                sum4(by[0], by[1], by[2], Vec(0.0f), by_axis + (first + i) * 4);
            }
        }
    }
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
