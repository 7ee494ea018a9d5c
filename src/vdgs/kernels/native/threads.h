// A pool of threads that sleep when there is nothing to do.
//
// Idle workers block on a condition variable and never spin, so that they cost nothing on a busy
// machine. The pool starts with the first parallel call, serves one call at a time (a second caller,
// or a call from inside a task, simply works alone), and starts afresh in a forked child.
#pragma once

#include <algorithm>
#include <cstdint>

namespace vdgs {

// Most threads that one parallel call uses, the caller included. At least 1.
void set_threads(int count);
int threads();

namespace detail {
using Task = void (*)(const void* body, int64_t index);
void run(int64_t n_tasks, Task task, const void* body);
}  // namespace detail

// Calls body(0) .. body(n_tasks - 1), each once, in any order on any thread; whoever is free takes the
// next. Returns when all are done. The first exception stops the rest and reaches the caller. In the
// body, numbers nearer to 0 than 1.2e-38 count as 0.
template <class Body>
void parallel_for(int64_t n_tasks, const Body& body) {
  detail::run(n_tasks, [](const void* b, int64_t index) { (*static_cast<const Body*>(b))(index); }, &body);
}

// How many parts parallel_parts makes of n items: one per thread, but none smaller than `grain`.
inline int n_parts(int64_t n, int64_t grain) {
  const int64_t most = std::max<int64_t>(1, n / std::max<int64_t>(1, grain));
  return static_cast<int>(std::min<int64_t>(threads(), most));
}

// Where part `part` of `parts` begins; part `parts` begins at n.
inline int64_t part_begin(int64_t n, int part, int parts) {
  return n / parts * part + std::min<int64_t>(n % parts, part);
}

// Splits [0, n) into `parts` contiguous ranges of equal length and calls body(part, begin, end) for each.
template <class Body>
void parallel_parts(int64_t n, int parts, const Body& body) {
  parallel_for(parts, [&](int64_t part) {
    const int p = static_cast<int>(part);
    body(p, part_begin(n, p, parts), part_begin(n, p + 1, parts));
  });
}

}  // namespace vdgs
