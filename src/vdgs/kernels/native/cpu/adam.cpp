// Adam is bound by memory: one pass over the gradient to see that it is finite, one over everything.
#include "cpu/adam.h"

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <cstring>
#include <optional>

#include <nanobind/stl/optional.h>

#include "bindings.h"
#include "simd/simd.h"
#include "threads.h"

namespace vdgs {
namespace {

constexpr size_t kTaskFloats = 1 << 15;

struct Factors {
  F16 beta1, beta2, rest1, rest2, epsilon;
  // 1 - beta is taken in float64: in float32 1 - 0.999 is off by 5e-5.
  explicit Factors(const AdamStep& step)
      : beta1(rounded(step.beta1)), beta2(rounded(step.beta2)), rest1(rounded(1.0 - step.beta1)),
        rest2(rounded(1.0 - step.beta2)), epsilon(rounded(step.epsilon)) {}
  static F16 rounded(double value) { return splat(static_cast<float>(value)); }
};

// Rate and root for each float of a stretch of rows, or sixteen of each for all of them.
class Corrections {
 public:
  explicit Corrections(const AdamStep& step) : step_(step) {}

  // How many rows can be held at once.
  static size_t most(size_t width) { return std::max<size_t>(1, kFloats / width); }

  void for_all(int32_t updates) {
    stride_ = 0;
    put(0, step_.entry(updates));
  }

  // One entry for each of the rows; at most `most` of them.
  void for_each(const int32_t* updates, size_t rows, size_t width) {
    if (rows == 1) return for_all(updates[0]);
    stride_ = 1;
    // What is written beyond the end of a row, the next row overwrites.
    for (size_t row = 0; row < rows; ++row)
      for (size_t i = 0; i < width; i += kLanes) put(row * width + i, step_.entry(updates[row]));
  }

  VDGS_INLINE F16 rate(size_t i) const { return loadu(rate_ + stride_ * i); }
  VDGS_INLINE F16 root(size_t i) const { return loadu(root_ + stride_ * i); }

 private:
  static constexpr size_t kFloats = 1024;
  void put(size_t at, int64_t entry) {
    storeu(rate_ + at, splat(step_.rates[entry])), storeu(root_ + at, splat(step_.roots[entry]));
  }
  const AdamStep& step_;
  size_t stride_ = 0;
  float rate_[kFloats + kLanes], root_[kFloats + kLanes];
};

VDGS_INLINE void update(F16& parameter, F16& first, F16& second, F16 gradient, F16 rate, F16 root, const Factors& f) {
  first = fma(f.beta1, first, f.rest1 * gradient);
  second = fma(f.beta2, second, f.rest2 * (gradient * gradient));
  parameter = parameter - rate * first / fma(sqrt(second), root, f.epsilon);
}

// A stretch of floats that lie side by side in all four arrays.
void update_stretch(float* parameter, float* first, float* second, const float* gradient, size_t size,
                    const Corrections& corrections, const Factors& factors) {
  size_t i = 0;
  for (; i + kLanes <= size; i += kLanes) {
    F16 p = loadu(parameter + i), m = loadu(first + i), v = loadu(second + i);
    update(p, m, v, loadu(gradient + i), corrections.rate(i), corrections.root(i), factors);
    storeu(parameter + i, p), storeu(first + i, m), storeu(second + i, v);
  }
  if (i == size) return;
  const int rest = static_cast<int>(size - i);
  F16 p = load_first(parameter + i, rest), m = load_first(first + i, rest), v = load_first(second + i, rest);
  update(p, m, v, load_first(gradient + i, rest), corrections.rate(i), corrections.root(i), factors);
  store_first(parameter + i, rest, p), store_first(first + i, rest, m), store_first(second + i, rest, v);
}

int64_t tasks(size_t size, size_t each) { return static_cast<int64_t>((size + each - 1) / each); }

bool finite_throughout(const float* values, size_t size) {
  std::atomic<bool> finite{true};
  parallel_for(tasks(size, kTaskFloats), [&](int64_t task) {
    const size_t begin = static_cast<size_t>(task) * kTaskFloats, end = std::min(size, begin + kTaskFloats);
    if (!all_finite(values + begin, end - begin)) finite.store(false, std::memory_order_relaxed);
  });
  return finite.load();
}

// As adam_update, threaded; rows ascend without repetition.
void adam_rows(const AdamRows& state, const int64_t* rows, size_t count, const float* gradient,
               const int32_t* updates) {
  const size_t width = state.width, each = std::max<size_t>(1, kTaskFloats / std::max<size_t>(1, width));
  parallel_for(tasks(count, each), [&](int64_t task) {
    const size_t begin = static_cast<size_t>(task) * each, n = std::min(count - begin, each);
    const int32_t* counted = updates ? updates + begin : nullptr;
    if (rows) return adam_update(state, rows + begin, n, gradient + begin * width, counted);
    const size_t at = begin * width;
    adam_update({state.parameter + at, state.first + at, state.second + at, width, state.step}, nullptr, n,
                gradient + at, counted);
  });
}

using State = Array<float, nb::ndim<2>>;

using Table = Array<const float, nb::ndim<1>>;

bool bound(State parameter, std::optional<Array<const int64_t, nb::ndim<1>>> rows,
           Array<const float, nb::ndim<2>> gradient, State first, State second,
           std::optional<Array<const int32_t, nb::ndim<1>>> updates, Table rates, Table roots, double beta1,
           double beta2, double epsilon) {
  nb::gil_scoped_release release;
  if (!finite_throughout(gradient.data(), gradient.size())) return false;
  const AdamRows state{parameter.data(), first.data(), second.data(), gradient.shape(1),
                       {rates.data(), roots.data(), static_cast<int64_t>(rates.size()), beta1, beta2, epsilon}};
  adam_rows(state, rows ? rows->data() : nullptr, gradient.shape(0), gradient.data(),
            updates ? updates->data() : nullptr);
  return true;
}

}  // namespace

bool all_finite(const float* values, size_t size) {
  uint32_t bad = 0;
  for (size_t i = 0; i < size; ++i) {
    uint32_t bits;
    std::memcpy(&bits, values + i, sizeof bits);
    bad |= (bits & 0x7f800000u) == 0x7f800000u;
  }
  return bad == 0;
}

void adam_update(const AdamRows& state, const int64_t* rows, size_t count, const float* gradient,
                 const int32_t* updates) {
  const Factors factors(state.step);
  Corrections corrections(state.step);
  if (!updates) corrections.for_all(1);
  const size_t width = state.width, most = updates ? Corrections::most(width) : count;
  for (size_t begin = 0, stop = 0; begin < count; begin = stop) {
    // Neighbors in the list that are neighbors in memory go together.
    const size_t end = std::min(count, begin + most);
    stop = rows ? begin + 1 : end;
    while (stop < end && rows[stop] == rows[stop - 1] + 1) ++stop;
    if (updates) corrections.for_each(updates + begin, stop - begin, width);
    const size_t at = (rows ? static_cast<size_t>(rows[begin]) : begin) * width;
    update_stretch(state.parameter + at, state.first + at, state.second + at, gradient + begin * width,
                   (stop - begin) * width, corrections, factors);
  }
}

VDGS_BIND(adam_rows) {
  m.def("adam_rows", &bound, nb::arg("parameter"), nb::arg("rows").none(), nb::arg("gradient"), nb::arg("first"),
        nb::arg("second"), nb::arg("updates").none(), nb::arg("rates"), nb::arg("roots"), nb::arg("beta1"),
        nb::arg("beta2"), nb::arg("epsilon"));
}

}  // namespace vdgs
