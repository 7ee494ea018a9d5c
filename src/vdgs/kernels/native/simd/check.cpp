// Lets the tests hold every function of simd.h against NumPy, on each instruction set.
#include <nanobind/stl/string.h>

#include <stdexcept>
#include <string>
#include <vector>

#include "bindings.h"
#include "simd/simd.h"
#include "threads.h"

namespace {

using namespace vdgs;

F16 apply(const std::string& name, F16 x) {
  if (name == "exp2") return exp2(x);
  if (name == "log2") return log2(x);
  if (name == "exp") return exp(x);
  if (name == "log") return log(x);
  if (name == "sigmoid") return sigmoid(x);
  if (name == "reciprocal") return reciprocal(x);
  if (name == "exact_reciprocal") return exact_reciprocal(x);
  if (name == "rsqrt") return rsqrt(x);
  if (name == "sqrt") return sqrt(x);
  if (name == "floor") return floor(x);
  if (name == "abs") return abs(x);
  if (name == "truncate") return to_float(to_int(x));
  if (name == "hsum") return splat(hsum(x));
  if (name == "positive") return zero_unless(gt(x, splat(0.0f)), splat(1.0f));
  if (name == "clamp_unit") return clamp(x, 0.0f, 1.0f);
  throw std::invalid_argument("no such function: " + name);
}

// Sixteen at a time; the last few through load_first and store_first.
void elementwise(const std::string& name, Array<const float, nb::ndim<1>> in, Array<float, nb::ndim<1>> out) {
  const int64_t n = static_cast<int64_t>(in.shape(0));
  for (int64_t i = 0; i < n; i += kLanes) {
    const int count = static_cast<int>(std::min<int64_t>(kLanes, n - i));
    store_first(out.data() + i, count, apply(name, load_first(in.data() + i, count)));
  }
}

// in [48], out [96]: the columns of in as 16 rows of three, then the rows woven again.
void columns(Array<const float, nb::shape<48>> in, Array<float, nb::shape<96>> out) {
  F16 x, y, z;
  load3(in.data(), x, y, z);
  storeu(out.data(), x), storeu(out.data() + 16, y), storeu(out.data() + 32, z);
  store3(out.data() + 48, x, y, z);
}

// in [16], out [16]: the lanes above 0, packed; returns how many. Lanes beyond stay as they were.
int compress_positive(Array<const float, nb::shape<16>> in, Array<float, nb::shape<16>> out) {
  const F16 x = loadu(in.data());
  const M16 positive = gt(x, splat(0.0f));
  compress_store(out.data(), positive, x);
  return __builtin_popcount(bits(positive));
}

uint64_t column_of_bits(Array<const uint16_t, nb::shape<64>> in, int bit) {
  alignas(64) uint16_t masks[64];
  std::memcpy(masks, in.data(), sizeof masks);
  return bit_column(masks, bit);
}

// Runs n tasks, of which number `bad` (if any) throws; returns the sum of the task numbers.
int64_t sum_of_tasks(int64_t n, int64_t bad) {
  std::vector<int64_t> done(static_cast<size_t>(n), 0);
  parallel_for(n, [&](int64_t i) {
    if (i == bad) throw std::runtime_error("task failed on purpose");
    parallel_for(1, [&](int64_t) { done[i] += i; });
  });
  int64_t sum = 0;
  for (int64_t d : done) sum += d;
  return sum;
}

}  // namespace

VDGS_BIND(simd_check) {
  nb::module_ check = m.def_submodule("check", "Functions for the tests alone.");
  check.def("elementwise", &elementwise);
  check.def("columns", &columns);
  check.def("compress_positive", &compress_positive);
  check.def("column_of_bits", &column_of_bits);
  check.def("sum_of_tasks", &sum_of_tasks, nb::call_guard<nb::gil_scoped_release>());
}
