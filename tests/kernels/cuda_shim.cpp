// The scheduler of cuda_shim.h, and sort.h by the standard library.
#undef _FORTIFY_SOURCE  // it takes a jump to another stack for a mistake
#include "cuda_shim.h"

#include <setjmp.h>
#include <ucontext.h>

#include <algorithm>
#include <array>
#include <cstdlib>
#include <memory>
#include <numeric>
#include <stdexcept>
#include <vector>

#include "../../gsbench/kernels/cuda/sort.h"

#ifdef GSB_SHIM_RACES
#include <sanitizer/tsan_interface.h>
#else
#define __tsan_get_current_fiber() nullptr
#define __tsan_create_fiber(flags) nullptr
#define __tsan_destroy_fiber(fiber)
#define __tsan_switch_to_fiber(fiber, flags)
#define __tsan_acquire(token)
#define __tsan_release(token)
#endif

namespace gsb::cuda {
namespace shim {

const Thread* thread = nullptr;
dim3 block_index, block_size, grid_size;

namespace {

constexpr size_t STACK = 256 * 1024;
enum class State { ready, at_warp, at_barrier, done };

// Where a fiber or the scheduler goes on. Jumps cost no system call, as swapcontext does; sanitizers follow it alone.
#if defined(__SANITIZE_ADDRESS__) || defined(GSB_SHIM_RACES)
struct Place {
    ucontext_t context;
};
void go(Place& from, Place& to) { swapcontext(&from.context, &to.context); }
#else
struct Place {
    ucontext_t context;  // where it begins
    jmp_buf left;
    bool begun = true;
};
[[gnu::noinline]] void go(Place& from, Place& to) {
    if (_setjmp(from.left)) return;
    if (to.begun) _longjmp(to.left, 1);
    to.begun = true;
    setcontext(&to.context);
}
#endif

struct Fiber {
    Thread thread;
    Place place;
    State state = State::ready;
    uint32_t given = 0;
    unsigned block_syncs = 0, warp_syncs = 0;  // that it took part in
    void* sanitized = __tsan_create_fiber(0);

    Fiber() = default;
    Fiber(Fiber&&) = default;
    ~Fiber() { __tsan_destroy_fiber(sanitized); }
};

// What the threads of a block or warp did before they met is known to each of them after. Two, as some are on the way to
// the next meeting while others leave the last.
using Meetings = std::array<char, 2>;

struct Block {
    std::vector<Fiber> fibers;
    std::vector<std::array<uint32_t, 32>> exchanged;  // by warp
    Meetings met;
    std::vector<Meetings> warps_met;
    char begun, ended;
    Place scheduler;
    void* sanitized = __tsan_get_current_fiber();
    const std::function<void()>* body = nullptr;
};
Block* block = nullptr;
std::vector<std::unique_ptr<char[]>> stacks;  // of the fibers, kept for the next kernel
constexpr unsigned UNORDERED = 1;  // switching alone makes nothing known: what races on a GPU, races here

Fiber& current() { return block->fibers[thread->number]; }

void wait(State state) {
    Fiber& fiber = current();
    fiber.state = state;
    __tsan_switch_to_fiber(block->sanitized, UNORDERED);
    go(fiber.place, block->scheduler);
}

void enter() {
    __tsan_acquire(&block->begun);
    __tsan_acquire(&block->ended);  // blocks are taken to run one after the other
    (*block->body)();
    __tsan_release(&block->ended);
    wait(State::done);
}

// Lets fibers [begin, end) go on if all that live wait in `state`. Returns whether any does.
bool release(size_t begin, size_t end, State state) {
    bool any = false;
    for (size_t i = begin; i < end; ++i) {
        const State s = block->fibers[i].state;
        if (s != state && s != State::done) return false;
        any |= s == state;
    }
    for (size_t i = begin; i < end; ++i) {
        Fiber& fiber = block->fibers[i];
        const bool done = fiber.state == State::done;
        if (state == State::at_warp) block->exchanged[begin / 32][i - begin] = done ? 0 : fiber.given;
        if (!done) fiber.state = State::ready;
    }
    return any;
}

void run_block() {
    const size_t count = block->fibers.size();
    // Where a barrier is missing, what a thread sees of another's work depends on which of them goes first.
    const bool reversed = std::getenv("GSBENCH_SHIM_REVERSED") != nullptr;
    for (;;) {
        for (size_t i = 0; i < count; ++i) {
            Fiber& fiber = block->fibers[reversed ? count - 1 - i : i];
            if (fiber.state != State::ready) continue;
            thread = &fiber.thread;
            __tsan_switch_to_fiber(fiber.sanitized, UNORDERED);
            go(block->scheduler, fiber.place);
        }
        bool progress = false;
        for (size_t warp = 0; warp < count; warp += 32) {
            progress |= release(warp, std::min(warp + 32, count), State::at_warp);
        }
        progress |= release(0, count, State::at_barrier);
        if (progress) continue;
        if (std::all_of(block->fibers.begin(), block->fibers.end(), [](auto& f) { return f.state == State::done; })) {
            return;
        }
        throw std::runtime_error("shim: deadlock: some threads wait for the block and some for their warp");
    }
}

}  // namespace

void barrier() {
    [[maybe_unused]] char& met = block->met[current().block_syncs++ % 2];
    __tsan_release(&met);
    wait(State::at_barrier);
    __tsan_acquire(&met);
}

void sync_warp() {
    [[maybe_unused]] char& met = block->warps_met[thread->number / 32][current().warp_syncs++ % 2];
    __tsan_release(&met);
    exchange(0);
    __tsan_acquire(&met);
}

const uint32_t* exchange(uint32_t mine) {
    current().given = mine;
    wait(State::at_warp);
    return block->exchanged[thread->number / 32].data();
}

void run(dim3 grid, dim3 size, const std::function<void()>& body) {
    Block b;
    b.fibers = std::vector<Fiber>(size_t{size.x} * size.y * size.z);
    while (stacks.size() < b.fibers.size()) stacks.emplace_back(new char[STACK]);
    b.exchanged.resize((b.fibers.size() + 31) / 32);
    b.warps_met.resize(b.exchanged.size());
    b.body = &body;
    block = &b;
    block_size = size, grid_size = grid;
    __tsan_release(&b.begun);
    const unsigned blocks = grid.x * grid.y * grid.z;
    for (unsigned i = 0; i < blocks; ++i) {
        block_index = {i % grid.x, i / grid.x % grid.y, i / (grid.x * grid.y)};
        for (unsigned n = 0; n < b.fibers.size(); ++n) {
            Fiber& fiber = b.fibers[n];
            fiber.thread = {{n % size.x, n / size.x % size.y, n / (size.x * size.y)}, n};
            fiber.state = State::ready;
            ucontext_t& context = fiber.place.context;
            getcontext(&context);
            context.uc_stack.ss_sp = stacks[n].get();
            context.uc_stack.ss_size = STACK;
            context.uc_link = nullptr;
            makecontext(&context, enter, 0);
#if !defined(__SANITIZE_ADDRESS__) && !defined(GSB_SHIM_RACES)
            fiber.place.begun = false;
#endif
        }
        run_block();
    }
    __tsan_acquire(&b.ended);
}

}  // namespace shim

size_t sort_scratch(int64_t n) { return static_cast<size_t>(n); }

void need_scratch(size_t bytes, int64_t n) {  // as cub refuses
    if (bytes < sort_scratch(n)) throw std::runtime_error("too little scratch memory");
}

template <class Key>
void sort_pairs(void* scratch, size_t bytes, const Key* keys, Key* sorted_keys, const uint32_t* values,
                uint32_t* sorted_values, int64_t n, int bits, Stream) {
    need_scratch(bytes, n);
    std::memset(scratch, 0xff, bytes);  // cub writes there too
    const uint32_t mask = bits < 32 ? (1u << bits) - 1 : ~0u;
    std::vector<size_t> order(static_cast<size_t>(n));
    std::iota(order.begin(), order.end(), size_t{0});
    std::stable_sort(order.begin(), order.end(),
                     [&](size_t a, size_t b) { return (keys[a] & mask) < (keys[b] & mask); });
    for (size_t i = 0; i < order.size(); ++i) {
        sorted_keys[i] = keys[order[i]];
        sorted_values[i] = values[order[i]];
    }
}

template void sort_pairs(void*, size_t, const uint16_t*, uint16_t*, const uint32_t*, uint32_t*, int64_t, int, Stream);
template void sort_pairs(void*, size_t, const uint32_t*, uint32_t*, const uint32_t*, uint32_t*, int64_t, int, Stream);

void running_sum(void* scratch, size_t bytes, int64_t* values, int64_t n, Stream) {
    need_scratch(bytes, n);
    std::memset(scratch, 0xff, bytes);
    std::partial_sum(values, values + n, values);
}

}  // namespace gsb::cuda
