// Runs a CUDA kernel on the processor, to check its arithmetic where there is no GPU. Include the source after this.
//
// The threads of a block are fibers that take turns: each runs until it ends or waits at __syncthreads(), and only when
// all wait (or have ended) do they go on. One block runs at a time, so that `static` is what `__shared__` means. The
// fibers take turns forwards or backwards: a kernel that lacks a __syncthreads() gives different results.
#pragma once

#include <cmath>
#include <memory>
#include <utility>
#include <vector>

#include <ucontext.h>

#define __global__
#define __device__
#define __constant__
#define __shared__ static
#define __launch_bounds__(threads)

struct Index {
  unsigned x, y, z;
};
static Index threadIdx, blockIdx, blockDim, gridDim;

namespace host {

constexpr size_t kStackBytes = 64 * 1024;

struct Fiber {
  ucontext_t context;
  std::unique_ptr<char[]> stack{new char[kStackBytes]};
  Index index;
  bool waiting, ended;
};

using Kernel = void (*)(void** arguments);
static ucontext_t scheduler;
static Fiber* running;
static Kernel kernel_running;
static void** arguments_given;

inline void synchronise() {
  running->waiting = true;
  swapcontext(&running->context, &scheduler);
}

inline void begin_fiber() {
  kernel_running(arguments_given);
  running->ended = true;
}

inline void turn(Fiber& fiber) {
  running = &fiber;
  threadIdx = fiber.index;
  fiber.waiting = false;
  swapcontext(&scheduler, &fiber.context);
}

// False: some threads ended while others wait, which a GPU may not survive.
inline bool run_block(std::vector<Fiber>& fibers, bool backwards) {
  unsigned i = 0;
  for (Fiber& fiber : fibers) {
    fiber.index = {i % blockDim.x, i / blockDim.x % blockDim.y, i / (blockDim.x * blockDim.y)};
    fiber.ended = fiber.waiting = false;
    getcontext(&fiber.context);
    fiber.context.uc_stack.ss_sp = fiber.stack.get();
    fiber.context.uc_stack.ss_size = kStackBytes;
    fiber.context.uc_link = &scheduler;
    makecontext(&fiber.context, begin_fiber, 0);
    ++i;
  }
  for (;;) {
    size_t ended = 0;
    for (size_t f = 0; f < fibers.size(); ++f) {
      Fiber& fiber = fibers[backwards ? fibers.size() - 1 - f : f];
      turn(fiber);
      ended += fiber.ended;
    }
    if (ended == fibers.size()) return true;
    if (ended) return false;
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

#define __syncthreads host::synchronise
#define HOST_KERNEL(name) \
  extern "C" void host_##name(void** arguments) { host::Caller<name>::call(arguments); }

// Grid and block: three sides each. Returns false for a kernel whose threads do not all reach a barrier.
extern "C" int host_launch(host::Kernel kernel, const unsigned* grid, const unsigned* block, void** arguments,
                           int backwards) {
  gridDim = {grid[0], grid[1], grid[2]};
  blockDim = {block[0], block[1], block[2]};
  host::kernel_running = kernel;
  host::arguments_given = arguments;
  std::vector<host::Fiber> fibers(block[0] * block[1] * block[2]);
  for (unsigned z = 0; z < grid[2]; ++z)
    for (unsigned y = 0; y < grid[1]; ++y)
      for (unsigned x = 0; x < grid[0]; ++x) {
        blockIdx = {x, y, z};
        if (!host::run_block(fibers, backwards)) return 0;
      }
  return 1;
}
