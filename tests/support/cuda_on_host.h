// Runs a CUDA kernel on the processor, to check its arithmetic where there is no GPU. Include the sources after this.
//
// The threads of a block are fibers that take turns: each runs until it ends, or waits at a barrier of the block or in an
// operation of its warp. Warps take turns too, and a warp goes on as long as it can: to the next barrier of the block.
// Threads, warps and blocks take turns forwards, backwards or shuffled: a kernel that lacks a barrier, or in which blocks
// lean on each other's order, gives different results. One block runs at a time, so that `static` is what `__shared__` means.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <map>
#include <memory>
#include <numeric>
#include <utility>
#include <vector>

#include <setjmp.h>
#include <ucontext.h>

// What the headers that are shared with the processor go by.
#define __CUDACC_RTC__
#define __forceinline__ inline
#define __host__
#define __global__
#define __device__
#define __constant__
#define __shared__ static
#define __launch_bounds__(...)

struct Index {
  unsigned x, y, z;
};
static Index threadIdx, blockIdx, blockDim, gridDim;

inline unsigned __float_as_uint(float a) {
  unsigned bits;
  std::memcpy(&bits, &a, sizeof bits);
  return bits;
}

namespace host {

constexpr size_t kStackBytes = 64 * 1024;
constexpr unsigned kWarp = 32;

enum class State { ready, at_barrier, in_warp, ended };

struct Fiber {
  ucontext_t context;
  jmp_buf place;
  bool begun = false;
  std::unique_ptr<char[]> stack{new char[kStackBytes]};
  Index index;
  unsigned lane;
  State state;
  // What it brings to barriers that ask and to operations of the warp; every other one has its own place, so that
  // nobody overwrites what another has not read yet.
  unsigned barriers, exchanges;
  bool vote[2];
  uint32_t given[2];
};

using Kernel = void (*)(void** arguments);
static ucontext_t scheduler_context;
static jmp_buf scheduler;
static std::vector<Fiber> fibers;
static Fiber* running;
static Kernel kernel_running;
static void** arguments_given;

// Lanes of the warp whose turn it is that have not had theirs, in their order, and its first fiber.
static const size_t *next_lane, *last_lane;
static Fiber* warp_running;

inline Fiber* next_ready() {
  while (next_lane != last_lane)
    if (Fiber& fiber = warp_running[*next_lane++]; fiber.state == State::ready) return &fiber;
  return nullptr;
}

inline void choose(Fiber& fiber) {
  running = &fiber;
  threadIdx = fiber.index;
}

// Fibers are begun by swapcontext and change by longjmp, which asks nothing of the system: where they can, to the next
// lane and not by the scheduler.
inline void wait(State why) {
  running->state = why;
  if (_setjmp(running->place)) return;
  if (Fiber* next = next_ready()) {
    if (next->begun) choose(*next), _longjmp(next->place, 1);
    --next_lane;
  }
  _longjmp(scheduler, 1);
}

// A fiber serves one block after another, of all launches of as many threads: to begin it asks the system.
inline void begin_fiber() {
  for (;;) {
    kernel_running(arguments_given);
    wait(State::ended);
  }
}

inline void turn(Fiber& fiber) {
  choose(fiber);
  if (_setjmp(scheduler)) return;
  if (fiber.begun) _longjmp(fiber.place, 1);
  fiber.begun = true;
  swapcontext(&scheduler_context, &fiber.context);
}

// What the threads of a block were last answered, and which barrier it was: the first of them counts for all.
static bool answer;
static unsigned answered;

template <class Join>
bool ask(bool mine, bool start, Join join) {
  const unsigned place = running->barriers++ % 2;
  running->vote[place] = mine;
  wait(State::at_barrier);
  if (const unsigned asked = 2 * running->barriers + start; answered != asked) {
    answered = asked, answer = start;
    for (Fiber& fiber : fibers) answer = join(answer, fiber.vote[place]);
  }
  return answer;
}

inline Fiber& lane_of_my_warp(unsigned lane) {
  return fibers[(running - fibers.data()) / kWarp * kWarp + lane];
}

template <class T>
unsigned exchange(T mine, bool vote) {
  static_assert(sizeof mine == sizeof(uint32_t));
  const unsigned place = running->exchanges++ % 2;
  std::memcpy(&running->given[place], &mine, sizeof mine);
  running->vote[place] = vote;  // barriers and warps never wait at once
  wait(State::in_warp);
  return place;
}

template <class T>
T given_by(unsigned lane, unsigned place) {
  T given;
  std::memcpy(&given, &lane_of_my_warp(lane).given[place], sizeof given);
  return given;
}

// All lanes that have not ended must take part, as the mask of all lanes says.
inline bool release_warp(size_t warp) {
  unsigned waiting = 0;
  for (unsigned lane = 0; lane < kWarp; ++lane) waiting += fibers[warp * kWarp + lane].state == State::in_warp;
  if (waiting != kWarp) return false;
  for (unsigned lane = 0; lane < kWarp; ++lane) fibers[warp * kWarp + lane].state = State::ready;
  return true;
}

// 0 forwards, 1 backwards, else a shuffle that the number stands for.
inline std::vector<size_t> order_of(size_t count, unsigned turns) {
  std::vector<size_t> order(count);
  std::iota(order.begin(), order.end(), size_t{0});
  if (turns == 1) return {order.rbegin(), order.rend()};
  uint32_t state = turns;
  for (size_t i = count; turns > 1 && i > 1; --i) {
    state = state * 1664525u + 1013904223u;
    std::swap(order[i - 1], order[(state >> 8) % i]);
  }
  return order;
}

static std::map<size_t, std::vector<Fiber>> others;

// The fibers of as many threads, begun as far as there were any.
inline void provide_fibers(size_t threads) {
  if (fibers.size() == threads) return;
  std::swap(others[fibers.size()], fibers);
  std::swap(others[threads], fibers);
  if (!fibers.empty()) return;
  fibers = std::vector<Fiber>(threads);
  for (Fiber& fiber : fibers) {
    getcontext(&fiber.context);
    fiber.context.uc_stack.ss_sp = fiber.stack.get();
    fiber.context.uc_stack.ss_size = kStackBytes;
    fiber.context.uc_link = nullptr;
    makecontext(&fiber.context, begin_fiber, 0);
  }
}

// False: threads wait for others that never come, which a GPU may not survive.
inline bool run_block(unsigned turns) {
  unsigned i = 0;
  answered = 0;
  for (Fiber& fiber : fibers) {
    fiber.index = {i % blockDim.x, i / blockDim.x % blockDim.y, i / (blockDim.x * blockDim.y)};
    fiber.lane = i % kWarp;
    fiber.state = State::ready;
    fiber.barriers = fiber.exchanges = 0;
    ++i;
  }
  const size_t warps = fibers.size() / kWarp;
  const std::vector<size_t> by_warp = order_of(warps, turns), by_lane = order_of(kWarp, turns);
  for (;;) {
    for (size_t warp : by_warp) {
      warp_running = &fibers[warp * kWarp];
      do {
        next_lane = by_lane.data(), last_lane = next_lane + kWarp;
        while (Fiber* fiber = next_ready()) turn(*fiber);
      } while (release_warp(warp));
    }
    size_t ended = 0, waiting = 0;
    for (Fiber& fiber : fibers) ended += fiber.state == State::ended, waiting += fiber.state == State::at_barrier;
    if (ended == fibers.size()) return true;
    if (waiting != fibers.size()) return false;
    for (Fiber& fiber : fibers) fiber.state = State::ready;
  }
}

// Calls a kernel with what the driver's array of pointers leads to.
template <auto kernel>
struct Caller;
template <class... A, void (*kernel)(A...)>
struct Caller<kernel> {
  static void call(void** arguments) { spread(arguments, std::index_sequence_for<A...>()); }
  template <size_t... i>
  static void spread(void** arguments, std::index_sequence<i...>) {
    kernel(*static_cast<A*>(arguments[i])...);
  }
};

}  // namespace host

inline void __syncthreads() { host::wait(host::State::at_barrier); }
inline int __syncthreads_or(int mine) {
  return host::ask(mine, false, [](bool a, bool b) { return a || b; });
}
inline int __syncthreads_and(int mine) {
  return host::ask(mine, true, [](bool a, bool b) { return a && b; });
}
inline float __shfl_xor_sync(unsigned, float mine, int lanes) {
  const unsigned place = host::exchange(mine, false);
  return host::given_by<float>(host::running->lane ^ lanes, place);
}
inline float __shfl_sync(unsigned, float mine, int lane) {
  const unsigned place = host::exchange(mine, false);
  return host::given_by<float>(lane, place);
}
inline void __syncwarp() { host::exchange(0.0f, false); }
// The sources' barriers have numbers: that of one which is left out, to see whether it is needed.
static int left_out;
inline void maybe_syncthreads(int number) { number != left_out ? __syncthreads() : void(); }
inline int maybe_syncthreads_or(int number, int mine) { return number != left_out ? __syncthreads_or(mine) : mine; }
inline int maybe_syncthreads_and(int number, int mine) { return number != left_out ? __syncthreads_and(mine) : mine; }
inline void maybe_syncwarp(int number) { number != left_out ? __syncwarp() : void(); }
inline unsigned __ballot_sync(unsigned, int mine) {
  const unsigned place = host::exchange(0.0f, mine);
  unsigned all = 0;
  for (unsigned lane = 0; lane < host::kWarp; ++lane) all |= unsigned{host::lane_of_my_warp(lane).vote[place]} << lane;
  return all;
}
// Threads take turns, so that nobody comes in between.
inline int atomicAdd(int* at, int more) {
  const int before = *at;
  *at = before + more;
  return before;
}
// A card computes these less exactly.
inline float __expf(float a) { return std::exp(a); }
inline float __fdividef(float a, float b) { return a / b; }
inline int __popc(unsigned bits) { return __builtin_popcount(bits); }
inline int __any_sync(unsigned, int mine) {
  const unsigned place = host::exchange(0.0f, mine);
  for (unsigned lane = 0; lane < host::kWarp; ++lane)
    if (host::lane_of_my_warp(lane).vote[place]) return 1;
  return 0;
}

// For those who watch what threads do: the block that runs, and its thread.
extern "C" unsigned long long host_block() {
  return (static_cast<unsigned long long>(blockIdx.z) * gridDim.y + blockIdx.y) * gridDim.x + blockIdx.x;
}
extern "C" unsigned long long host_thread() { return static_cast<unsigned long long>(host::running - host::fibers.data()); }

#define HOST_KERNEL(name) \
  extern "C" void host_##name(void** arguments) { host::Caller<name>::call(arguments); }

// Grid and block: three sides each; a block is whole warps. Returns false for a kernel whose threads wait in vain.
extern "C" int host_launch(host::Kernel kernel, const unsigned* grid, const unsigned* block, void** arguments,
                           unsigned turns, int without_barrier) {
  left_out = without_barrier;
  gridDim = {grid[0], grid[1], grid[2]};
  blockDim = {block[0], block[1], block[2]};
  host::kernel_running = kernel;
  host::arguments_given = arguments;
  const size_t threads = block[0] * block[1] * block[2];
  if (threads % host::kWarp) return 0;
  host::provide_fibers(threads);
  for (size_t b : host::order_of(size_t{grid[0]} * grid[1] * grid[2], turns)) {
    const unsigned i = static_cast<unsigned>(b);
    blockIdx = {i % grid[0], i / grid[0] % grid[1], i / (grid[0] * grid[1])};
    if (host::run_block(turns)) continue;
    host::fibers.clear();  // they stand in the middle of the kernel
    return 0;
  }
  return 1;
}
