// Adam is bound by memory: one pass over the gradient to see that it is finite, one over everything.
#include "adam.h"

#include <algorithm>
#include <atomic>
#include <cstring>

#include "simd.h"
#include "threads.h"

namespace vdgs {
namespace {

constexpr size_t kTaskFloats = 1 << 15;

struct Factors {
  F16 rate, root, beta1, beta2, rest1, rest2, epsilon;
  explicit Factors(const AdamStep& step)
      : rate(splat(step.rate)), root(splat(step.root)), beta1(splat(step.beta1)), beta2(splat(step.beta2)),
        rest1(splat(1.0f - step.beta1)), rest2(splat(1.0f - step.beta2)), epsilon(splat(step.epsilon)) {}
};

VDGS_INLINE void update(F16& parameter, F16& first, F16& second, F16 gradient, const Factors& f) {
  first = fma(f.beta1, first, f.rest1 * gradient);
  second = fma(f.beta2, second, f.rest2 * (gradient * gradient));
  parameter = parameter - f.rate * first / fma(sqrt(second), f.root, f.epsilon);
}

// A stretch of floats that lie side by side in all four arrays.
void update_stretch(float* parameter, float* first, float* second, const float* gradient, size_t size,
                    const Factors& factors) {
  size_t i = 0;
  for (; i + kLanes <= size; i += kLanes) {
    F16 p = loadu(parameter + i), m = loadu(first + i), v = loadu(second + i);
    update(p, m, v, loadu(gradient + i), factors);
    storeu(parameter + i, p), storeu(first + i, m), storeu(second + i, v);
  }
  if (i == size) return;
  const int rest = static_cast<int>(size - i);
  F16 p = load_first(parameter + i, rest), m = load_first(first + i, rest), v = load_first(second + i, rest);
  update(p, m, v, load_first(gradient + i, rest), factors);
  store_first(parameter + i, rest, p), store_first(first + i, rest, m), store_first(second + i, rest, v);
}

// Rows [begin, end) of the list; neighbours in the list that are neighbours in memory go together.
void update_rows(float* parameter, const int64_t* rows, size_t begin, size_t end, size_t width, const float* gradient,
                 float* first, float* second, const Factors& factors) {
  while (begin < end) {
    size_t stop = begin + 1;
    if (rows) {
      while (stop < end && rows[stop] == rows[stop - 1] + 1) ++stop;
    } else {
      stop = end;
    }
    const size_t at = (rows ? static_cast<size_t>(rows[begin]) : begin) * width;
    update_stretch(parameter + at, first + at, second + at, gradient + begin * width, (stop - begin) * width, factors);
    begin = stop;
  }
}

bool stretch_finite(const float* values, size_t size) {
  uint32_t bad = 0;
  for (size_t i = 0; i < size; ++i) {
    uint32_t bits;
    std::memcpy(&bits, values + i, sizeof bits);
    bad |= (bits & 0x7f800000u) == 0x7f800000u;
  }
  return bad == 0;
}

size_t tasks(size_t size, size_t each) { return (size + each - 1) / each; }

}  // namespace

bool all_finite(const float* values, size_t size) {
  std::atomic<bool> finite{true};
  parallel_for(tasks(size, kTaskFloats), [&](size_t task) {
    const size_t begin = task * kTaskFloats, end = std::min(size, begin + kTaskFloats);
    if (!stretch_finite(values + begin, end - begin)) finite.store(false, std::memory_order_relaxed);
  });
  return finite.load();
}

void adam_rows(float* parameter, const int64_t* rows, size_t count, size_t width, const float* gradient, float* first,
               float* second, const AdamStep& step) {
  // A row's lanes may be cut differently by different runs of neighbours, but every lane is computed alike.
  const Factors factors(step);
  const size_t each = std::max<size_t>(1, kTaskFloats / std::max<size_t>(1, width));
  parallel_for(tasks(count, each), [&](size_t task) {
    update_rows(parameter, rows, task * each, std::min(count, (task + 1) * each), width, gradient, first, second,
                factors);
  });
}

}  // namespace vdgs
