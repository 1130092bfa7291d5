// The training loss (1 - w) L1 + w (1 - SSIM) and its gradient in one pass over the rows of two pictures.
//
// A row of pixels is filtered along x when it is read, and along y when the eleven rows about it have been; the
// derivatives of SSIM go through the same filter once more on their way to the gradient. Only the last eleven rows of
// each are kept, so everything stays in cache.
#include "../math/similarity.h"

#include "buffer.h"
#include "isa.h"
#include "simd.h"

namespace gsb {
inline namespace GSB_ISA {
namespace {

constexpr int CHANNELS = 3;
constexpr int MARGIN = 16;  // zeros on either side of a row: SSIM_RADIUS pixels of three channels, in whole vectors
constexpr int MOMENTS = 5, DERIVATIVES = 3;
static_assert(MARGIN >= SSIM_RADIUS * CHANNELS && MARGIN % LANES == 0);

struct Window {
    float weight[SSIM_WINDOW];

    Window() {
        double total = 0.0, w[SSIM_WINDOW];
        for (int i = 0; i < SSIM_WINDOW; ++i) {
            const double x = i - SSIM_RADIUS;
            total += w[i] = ::exp(-x * x / (2.0 * SSIM_SIGMA * SSIM_SIGMA));
        }
        for (int i = 0; i < SSIM_WINDOW; ++i) weight[i] = static_cast<float>(w[i] / total);
    }
};

// The last eleven rows of `planes` filtered quantities.
struct Ring {
    int planes, stride;
    Buffer<float> rows;

    Ring(int planes, int stride)
        : planes(planes), stride(stride), rows(static_cast<size_t>(SSIM_WINDOW) * planes * stride) {}

    float* row(int y, int plane) {
        return rows.data() + static_cast<size_t>((y % SSIM_WINDOW) * planes + plane) * stride;
    }
};

// A horizontal strip of the picture, rows [begin, end), with memory of its own.
struct Strip {
    const SimilarityArgs& args;
    const Window& window;
    int begin, end, width, stride;  // width: floats of a row
    Ring moments, derivatives;
    Buffer<float> padded;  // rows before the filter along x; what is outside of the picture stays zero

    Strip(const SimilarityArgs& a, const Window& window, int begin, int end)
        : args(a), window(window), begin(begin), end(end), width(a.width * CHANNELS),
          stride((width + LANES - 1) / LANES * LANES), moments(MOMENTS, stride), derivatives(DERIVATIVES, stride),
          padded(static_cast<size_t>(MOMENTS) * (stride + 2 * MARGIN)) {
        padded.zero();
    }

    float* padded_row(int plane) { return padded.data() + static_cast<size_t>(plane) * (stride + 2 * MARGIN) + MARGIN; }

    // Planes of padded_row, filtered along x, to row y of a ring.
    template <int PLANES>
    void filter_along_x(Ring& ring, int y) {
        for (int x = 0; x < stride; x += LANES) {
            Vec sums[PLANES];
            for (auto& sum : sums) sum = Vec(0.0f);
            for (int tap = 0; tap < SSIM_WINDOW; ++tap) {
                const int at = x + (tap - SSIM_RADIUS) * CHANNELS;
                for (int k = 0; k < PLANES; ++k) sums[k] += Vec::load(padded_row(k) + at) * window.weight[tap];
            }
            for (int k = 0; k < PLANES; ++k) sums[k].store(ring.row(y, k) + x);
        }
    }

    // The value at x of row y of a ring's planes, filtered along y.
    template <int PLANES>
    void filter_along_y(Ring& ring, int y, int x, Vec (&sums)[PLANES]) {
        for (auto& sum : sums) sum = Vec(0.0f);
        const int first = y < SSIM_RADIUS ? -y : -SSIM_RADIUS;
        const int last = args.height - 1 - y < SSIM_RADIUS ? args.height - 1 - y : SSIM_RADIUS;
        for (int dy = first; dy <= last; ++dy) {
            const float weight = window.weight[dy + SSIM_RADIUS];
            for (int k = 0; k < PLANES; ++k) sums[k] += Vec::load(ring.row(y + dy, k) + x) * weight;
        }
    }

    void read_row(int y) {
        const float *a = args.image + static_cast<int64_t>(y) * width, *b = args.target + static_cast<int64_t>(y) * width;
        for (int x = 0; x < width; x += LANES) {
            const int n = width - x < LANES ? width - x : LANES;
            const Vec va = load_first(a + x, n), vb = load_first(b + x, n);
            const Vec values[MOMENTS] = {va, vb, va * va, vb * vb, va * vb};
            for (int k = 0; k < MOMENTS; ++k) values[k].store(padded_row(k) + x);
        }
        filter_along_x<MOMENTS>(moments, y);
    }

    // SSIM of row y, summed; its derivatives, filtered along x.
    float compare_row(int y) {
        Vec total(0.0f);
        for (int x = 0; x < stride; x += LANES) {
            Vec m[MOMENTS];
            filter_along_y(moments, y, x, m);
            const Similarity<Vec> s(m[0], m[1], m[2], m[3], m[4]);
            const int n = width - x < LANES ? width - x : LANES;
            alignas(64) float lanes[LANES] = {};
            store_first(s.value, lanes, n);
            total += Vec::load(lanes);
            store_first(s.g_mean, padded_row(0) + x, n);
            store_first(s.g_square, padded_row(1) + x, n);
            store_first(s.g_product, padded_row(2) + x, n);
        }
        if (args.grad) filter_along_x<DERIVATIVES>(derivatives, y);
        return sum(total);
    }

    // The gradient of row y; returns the row's sum of |a - b|.
    float finish_row(int y) {
        const int64_t row = static_cast<int64_t>(y) * width;
        const float pixels = static_cast<float>(args.height) * static_cast<float>(width);
        const Vec l1((1.0f - args.ssim_weight) / pixels), ssim(-args.ssim_weight / pixels), zero(0.0f);
        Vec total(0.0f);
        for (int x = 0; x < width; x += LANES) {
            const int n = width - x < LANES ? width - x : LANES;
            const Vec a = load_first(args.image + row + x, n), b = load_first(args.target + row + x, n);
            const Vec difference = a - b;
            total += max(difference, -difference);
            if (!args.grad) continue;
            Vec g[DERIVATIVES];
            filter_along_y(derivatives, y, x, g);
            const Vec sign = select(difference > zero, l1, select(difference < zero, -l1, zero));
            store_first(sign + ssim * (g[0] + a * g[1] * 2.0f + b * g[2]), args.grad + row + x, n);
        }
        return sum(total);
    }

    // row_sums [height][2]: of SSIM and of |a - b|.
    void run(float* row_sums) {
        const int reach = args.grad ? SSIM_RADIUS : 0;
        const auto within = [&](int y) { return y < 0 ? 0 : y > args.height ? args.height : y; };
        int read = within(begin - reach - SSIM_RADIUS), compared = within(begin - reach);
        for (int y = begin; y < end; ++y) {
            for (; compared < within(y + reach + 1); ++compared) {
                // Rows are read into the ring only as far as this row's window; older ones may go by then.
                for (; read < within(compared + SSIM_RADIUS + 1); ++read) read_row(read);
                const float similarity = compare_row(compared);
                if (compared >= begin && compared < end) row_sums[compared * 2] = similarity;
            }
            row_sums[y * 2 + 1] = finish_row(y);
        }
    }
};

}  // namespace

double l1_ssim(const SimilarityArgs& a) {
    const Window window;
    Buffer<float> row_sums(static_cast<size_t>(a.height) * 2);
    const int strips = a.threads < a.height ? a.threads : a.height;
#pragma omp parallel for num_threads(a.threads) schedule(static, 1)
    for (int i = 0; i < strips; ++i) {
        Strip strip(a, window, static_cast<int>(static_cast<int64_t>(a.height) * i / strips),
                    static_cast<int>(static_cast<int64_t>(a.height) * (i + 1) / strips));
        strip.run(row_sums.data());
    }
    double similarity = 0.0, difference = 0.0;
    for (int y = 0; y < a.height; ++y) {
        similarity += row_sums[static_cast<size_t>(y) * 2];
        difference += row_sums[static_cast<size_t>(y) * 2 + 1];
    }
    const double pixels = static_cast<double>(a.height) * a.width * CHANNELS;
    return (1.0 - a.ssim_weight) * difference / pixels + a.ssim_weight * (1.0 - similarity / pixels);
}

}  // namespace GSB_ISA
}  // namespace gsb
