// The training loss (1 - w) L1 + w (1 - SSIM) and its gradient, in one pass over the rows of two images. Several pairs
// of images are compared one after the other.
//
// A row of pixels is filtered along x when it is read, and along y, four rows at a time, when the rows around them have
// been read. The derivatives of SSIM pass through the same filter once more for the gradient. Only the last few rows
// are kept, with so few columns at a time that everything stays in cache.
#include "../math/similarity.h"

#include "buffer.h"
#include "isa.h"
#include "simd.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int CHANNELS = 3;
constexpr int MARGIN = 16;  // zeros on either side of a row: SSIM_RADIUS pixels of three channels, in whole vectors
constexpr int MOMENTS = 4;  // of a, b, a^2 + b^2 and a b: SSIM needs no more of the squares than their sum
constexpr int DERIVATIVES = 3;
#if defined(__AVX2__)
constexpr int GROUP = 4;  // rows filtered along y at once: they share most of the rows that they read
#else
constexpr int GROUP = 1;  // too few registers to keep those in
#endif
constexpr int SPAN = GROUP + SSIM_WINDOW - 1;  // rows that a group reads
constexpr int KEPT = SPAN + GROUP - 1;         // the last of them may come with others, which the next group reads
constexpr int PADDED = GROUP * DERIVATIVES > MOMENTS ? GROUP * DERIVATIVES : MOMENTS;
constexpr int COLUMNS = 448;  // pixels of a row at most: the rows that are kept then fit into 1 MiB
constexpr int HALO = 16;      // pixels beside them, whose derivatives reach them: 2 SSIM_RADIUS, in whole vectors
static_assert(HALO >= 2 * SSIM_RADIUS && HALO * CHANNELS % LANES == 0);
static_assert(MARGIN == LANES && MARGIN >= SSIM_RADIUS * CHANNELS);

struct Window {
    float weight[SSIM_RADIUS + 1];  // by the distance from the middle

    Window() {
        double total = 0.0, w[SSIM_RADIUS + 1];
        for (int i = 0; i <= SSIM_RADIUS; ++i) {
            w[i] = ::exp(-i * i / (2.0 * SSIM_SIGMA * SSIM_SIGMA));
            total += i ? 2.0 * w[i] : w[i];
        }
        for (int i = 0; i <= SSIM_RADIUS; ++i) weight[i] = static_cast<float>(w[i] / total);
    }
};

// The last rows of `planes` filtered quantities, and a row of zeros for all rows outside of the image.
struct Ring {
    int planes, stride, height, kept;
    Buffer<float> rows;

    Ring(int planes, int stride, int height)
        : planes(planes), stride(stride), height(height), kept(height < KEPT ? height : KEPT),
          rows(static_cast<size_t>(kept + 1) * planes * stride) {
        __builtin_memset(at(kept), 0, static_cast<size_t>(planes) * stride * sizeof(float));
    }

    float* at(int slot) { return rows.data() + static_cast<size_t>(slot) * planes * stride; }
    float* row(int y) { return at(y >= 0 && y < height ? y % kept : kept); }
};

// Returns the first n lanes of x, and zero in the others.
GSB_HD inline Vec first_of(Vec x, int n) {
    if (n == LANES) return x;
    alignas(64) float lanes[LANES] = {};
    store_first(x, lanes, n);
    return Vec::load(lanes);
}

// A part of the image, rows [begin, end) and columns [first, last), with memory of its own. HALO columns beside it are
// read too, so that wrong values at the cut do not reach it.
struct Strip {
    const SimilarityArgs& args;
    float* gradient;  // null: not wanted
    const Window& window;
    int begin, end, left, width, from, to, stride;  // floats of a row: those read begin at left, and [from, to) count
    Ring moments, derivatives;
    Buffer<float> padded;  // rows before the filter along x; what is outside of the picture stays zero

    Strip(const SimilarityArgs& a, float* gradient, const Window& window, int begin, int end, int first, int last)
        : args(a), gradient(gradient), window(window), begin(begin), end(end),
          left((first < HALO ? 0 : first - HALO) * CHANNELS),
          width((last + HALO < a.width ? last + HALO : a.width) * CHANNELS - left), from(first * CHANNELS - left),
          to(last * CHANNELS - left), stride((width + LANES - 1) / LANES * LANES), moments(MOMENTS, stride, a.height),
          derivatives(gradient ? DERIVATIVES : 0, stride, a.height),
          padded(static_cast<size_t>(PADDED) * (stride + 2 * MARGIN)) {
        padded.zero();
    }

    float* padded_row(int plane) { return padded.data() + static_cast<size_t>(plane) * (stride + 2 * MARGIN) + MARGIN; }

    // Returns `sum` plus the contributions of the pixels up to D away, the farthest first.
    template <int D = SSIM_RADIUS>
    GSB_HD Vec filtered_along_x(const float* p, Vec sum = Vec(0.0f)) const {
        if constexpr (D == 0) {
            return sum + Vec::load(p) * window.weight[0];
        } else {
            constexpr int to = D * CHANNELS;
            // The two farthest are loaded across cache lines, which a processor does while it shifts the others.
            const Vec pair =
                D == SSIM_RADIUS ? Vec::load(p - to) + Vec::load(p + to) : load_beside<-to>(p) + load_beside<to>(p);
            return filtered_along_x<D - 1>(p, sum + pair * window.weight[D]);
        }
    }

    // Filters padded_row(first) and the following ones along x, to row y of a ring.
    void filter_along_x(int first, Ring& ring, int y) {
        for (int k = 0; k < ring.planes; ++k) {
            const float* in = padded_row(first + k);
            float* out = ring.row(y) + static_cast<size_t>(k) * stride;
            for (int x = 0; x < stride; x += LANES) filtered_along_x(in + x).store(out + x);
        }
    }

    // The rows from which rows y .. y + GROUP - 1 of a ring are filtered. If fewer than GROUP rows are needed, the last
    // of these may hold arbitrary values.
    struct Rows {
        const float* row[SPAN];

        Rows(Ring& ring, int y) {
            for (int i = 0; i < SPAN; ++i) row[i] = ring.row(y + i - SSIM_RADIUS);
        }
    };

    // Filters the planes of a group of rows along y at column x.
    template <int PLANES>
    GSB_HD void filter_along_y(const Rows& rows, int x, Vec (&out)[GROUP][PLANES]) const {
        for (int k = 0; k < PLANES; ++k) {
            const auto at = [&](int i) { return Vec::load(rows.row[i] + k * stride + x); };
            GSB_UNROLL for (int j = 0; j < GROUP; ++j) {
                const int middle = j + SSIM_RADIUS;
                Vec sum(0.0f);
                GSB_UNROLL for (int d = SSIM_RADIUS; d > 0; --d) {
                    sum += (at(middle - d) + at(middle + d)) * window.weight[d];
                }
                out[j][k] = sum + at(middle) * window.weight[0];
            }
        }
    }

    // Returns the index of the first float that is read in row y.
    int64_t place(int y) const { return static_cast<int64_t>(y) * args.width * CHANNELS + left; }

    // Returns the first n floats of the target from index `at` on.
    GSB_HD Vec target(int64_t at, int n) const {
        return args.target_bytes ? over_255(load_bytes(args.target_bytes + at, n)) : load_first(args.target + at, n);
    }

    void read_row(int y) {
        const int64_t row = place(y);
        for (int x = 0; x < width; x += LANES) {
            const int n = width - x < LANES ? width - x : LANES;
            const Vec va = load_first(args.image + row + x, n), vb = target(row + x, n);
            const Vec values[MOMENTS] = {va, vb, va * va + vb * vb, va * vb};
            for (int k = 0; k < MOMENTS; ++k) values[k].store(padded_row(k) + x);
        }
        filter_along_x(0, moments, y);
    }

    // Computes SSIM of `count` rows from y on: each row's sum to row_sums[row][0], and its derivatives, filtered along
    // x.
    void compare_rows(int y, int count, float* row_sums) {
        const Rows rows(moments, y);
        Vec totals[GROUP];
        for (auto& total : totals) total = Vec(0.0f);
        for (int x = 0; x < stride; x += LANES) {
            Vec m[GROUP][MOMENTS];
            filter_along_y(rows, x, m);
            const int n = width - x < LANES ? width - x : LANES;
            for (int j = 0; j < count; ++j) {
                const Similarity<Vec> s(m[j][0], m[j][1], m[j][2], Vec(0.0f), m[j][3]);
                if (x >= from && x < to) totals[j] += first_of(s.value, n);
                if (!gradient) continue;
                const Vec values[DERIVATIVES] = {s.g_mean, s.g_square, s.g_product};
                for (int k = 0; k < DERIVATIVES; ++k) first_of(values[k], n).store(padded_row(j * DERIVATIVES + k) + x);
            }
        }
        for (int j = 0; j < count; ++j) {
            if (gradient) filter_along_x(j * DERIVATIVES, derivatives, y + j);
            if (y + j >= begin && y + j < end) row_sums[(y + j) * 2] += sum(totals[j]);
        }
    }

    // Computes the gradient of `count` rows from y on, and each row's sum of |a - b| to row_sums[row][1].
    void finish_rows(int y, int count, float* row_sums) {
        const float pixels = static_cast<float>(args.height) * static_cast<float>(args.width * CHANNELS);
        const Vec l1((1.0f - args.ssim_weight) / pixels), ssim(-args.ssim_weight / pixels), zero(0.0f);
        const Rows rows(derivatives, y);
        Vec totals[GROUP];
        for (auto& total : totals) total = zero;
        for (int x = from; x < to; x += LANES) {
            const int n = to - x < LANES ? to - x : LANES;
            Vec g[GROUP][DERIVATIVES];
            if (gradient) filter_along_y(rows, x, g);
            for (int j = 0; j < count; ++j) {
                const int64_t at = place(y + j) + x;
                const Vec a = load_first(args.image + at, n), b = target(at, n), difference = a - b;
                totals[j] += max(difference, -difference);
                if (!gradient) continue;
                const Vec sign = select(difference > zero, l1, select(difference < zero, -l1, zero));
                store_first(sign + ssim * (g[j][0] + a * g[j][1] * 2.0f + b * g[j][2]), gradient + at, n);
            }
        }
        for (int j = 0; j < count; ++j) row_sums[(y + j) * 2 + 1] += sum(totals[j]);
    }

    // Processes the part and adds to row_sums [height][2]: sums of SSIM and of |a - b|.
    void run(float* row_sums) {
        const int reach = gradient ? SSIM_RADIUS : 0;
        const auto within = [&](int y) { return y < 0 ? 0 : y > args.height ? args.height : y; };
        const auto at_most = [](int n) { return n < GROUP ? n : GROUP; };
        const int last = within(end + reach);
        int read = within(begin - reach - SSIM_RADIUS), compared = within(begin - reach);
        for (int y = begin; y < end; y += GROUP) {
            const int count = at_most(end - y);
            while (compared < within(y + count + reach)) {
                // Rows are read into the ring only as far as this group needs; older rows may be overwritten.
                const int group = at_most(last - compared);
                for (; read < within(compared + group + SSIM_RADIUS); ++read) read_row(read);
                compare_rows(compared, group, row_sums);
                compared += group;
            }
            finish_rows(y, count, row_sums);
        }
    }
};

// Compares one image with its target.
void compare(const SimilarityArgs& a, const SimilarityLoss& out, const Window& window) {
    Buffer<float> row_sums(static_cast<size_t>(a.height) * 2);
    row_sums.zero();
    const int blocks = (a.width + COLUMNS - 1) / COLUMNS;
    const int columns = (a.width + blocks * HALO - 1) / (blocks * HALO) * HALO;
    const int strips = a.threads < a.height ? a.threads : a.height;
#pragma omp parallel for num_threads(a.threads) schedule(static, 1)
    for (int i = 0; i < strips; ++i) {
        const int begin = static_cast<int>(static_cast<int64_t>(a.height) * i / strips);
        const int end = static_cast<int>(static_cast<int64_t>(a.height) * (i + 1) / strips);
        for (int first = 0; first < a.width; first += columns) {
            const int last = first + columns < a.width ? first + columns : a.width;
            Strip(a, out.gradient, window, begin, end, first, last).run(row_sums.data());
        }
    }
    double similarity = 0.0, difference = 0.0;
    for (int y = 0; y < a.height; ++y) {
        similarity += row_sums[static_cast<size_t>(y) * 2];
        difference += row_sums[static_cast<size_t>(y) * 2 + 1];
    }
    const double pixels = static_cast<double>(a.height) * a.width * CHANNELS;
    const double weight = a.ssim_weight;
    *out.loss = static_cast<float>((1.0 - weight) * difference / pixels + weight * (1.0 - similarity / pixels));
}

}  // namespace

void l1_ssim(const SimilarityArgs& a, const SimilarityLoss& out) {
    const Window window;
    for (int c = 0; c < a.C; ++c) {
        SimilarityArgs image = a;
        SimilarityLoss loss{out.loss + c, out.gradient, nullptr};
        begin_at_image(c, image, loss);
        compare(image, loss, window);
    }
}

}  // namespace GSB_ISA
}  // namespace gsb
