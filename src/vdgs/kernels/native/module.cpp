// The Python module: one per instruction set, each with the same contents.
#include "bindings.h"
#include "threads.h"

namespace {

#if defined(__x86_64__) || defined(__i386__)
bool supports_v3() {
  return __builtin_cpu_supports("avx") && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("bmi") &&
         __builtin_cpu_supports("bmi2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("f16c") &&
         __builtin_cpu_supports("lzcnt") && __builtin_cpu_supports("movbe") &&
         __builtin_cpu_supports("popcnt") && __builtin_cpu_supports("sse4.2");
}
bool supports_v4() {
  return supports_v3() && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
         __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") &&
         __builtin_cpu_supports("avx512vl");
}
#else
bool supports_v3() { return false; }
bool supports_v4() { return false; }
#endif

// The instruction sets that this processor and its operating system can run, best first.
nb::list supported() {
  nb::list names;
  if (supports_v4()) names.append("avx512");
  if (supports_v3()) names.append("avx2");
  names.append("portable");
  return names;
}

}  // namespace

VDGS_BIND(runtime) {
  m.attr("isa") = VDGS_ISA;
  m.def("supported", &supported);
  m.def("set_threads", &vdgs::set_threads, nb::arg("count"));
  m.def("threads", &vdgs::threads);
}

NB_MODULE(VDGS_MODULE, m) {
  // A tensor that is still alive when Python ends keeps its frame alive; that is no fault to report.
  nb::set_leak_warnings(false);
  vdgs::Binding::run_all(m);
}
