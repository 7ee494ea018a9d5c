// How a source file adds its functions to the Python module, with no central list:
//
//     VDGS_BIND(rasterize) { m.def("rasterize", ...); }
//
// The body runs once when the module is imported; `m` is the module.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

namespace nb = nanobind;

namespace vdgs {

// One body of VDGS_BIND, linked into the list of all of them before the module is imported.
class Binding {
 public:
  using Body = void (*)(nb::module_&);
  explicit Binding(Body body) : body_(body), next_(first_) { first_ = this; }
  static void run_all(nb::module_& m) {
    for (const Binding* b = first_; b; b = b->next_) b->body_(m);
  }

 private:
  Body body_;
  const Binding* next_;
  inline static const Binding* first_ = nullptr;
};

// Arrays as the kernels take them: contiguous, in main memory, not copied.
template <class Scalar, class... Shape>
using Array = nb::ndarray<Scalar, nb::c_contig, nb::device::cpu, Shape...>;

}  // namespace vdgs

#define VDGS_BIND(name)                                        \
  static void bind_##name(nb::module_& m);                     \
  static const ::vdgs::Binding binding_of_##name(bind_##name); \
  static void bind_##name([[maybe_unused]] nb::module_& m)
