// Decoding, as Python sees it.
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include "bindings.h"
#include "cpu/decode/decode.h"

namespace vdgs {
namespace {

template <class Scalar>
using Rows = Array<Scalar>;
using MaybeRows = std::optional<Array<float>>;
using MaybeGradient = std::optional<Array<const float>>;

using MaybeIndices = std::optional<Array<const int64_t>>;
// Positions, features, offsets and log-scales.
using AnchorTensors = std::array<Rows<const float>, 4>;
// Parameter, first and second moment, and the members of AdamStep: rates and roots, then betas and epsilon.
using StepArguments = std::tuple<Rows<float>, Rows<float>, Rows<float>, Rows<const float>, Rows<const float>,
                                 std::array<double, 3>>;

AnchorArrays anchor_arrays(const AnchorTensors& t, const MaybeIndices& rows) {
  const int64_t total = static_cast<int64_t>(t[0].shape(0));
  return {t[0].data(), t[1].data(), t[2].data(), t[3].data(), total, rows ? rows->data() : nullptr,
          rows ? static_cast<int64_t>(rows->shape(0)) : total, static_cast<int>(t[2].shape(1))};
}

// Twelve arrays, head by head, as three heads; throws where their shapes do not fit k.
template <class Scalar>
void heads_of(const nb::list& arrays, int k, Head<Scalar> (&heads)[kHeads]) {
  if (nb::len(arrays) != 12) throw nb::value_error("a decoder has twelve arrays");
  for (size_t h = 0; h < kHeads; ++h) {
    const auto w1 = nb::cast<Array<Scalar, nb::ndim<2>>>(arrays[4 * h]);
    const auto b1 = nb::cast<Array<Scalar, nb::ndim<1>>>(arrays[4 * h + 1]);
    const auto w2 = nb::cast<Array<Scalar, nb::ndim<2>>>(arrays[4 * h + 2]);
    const auto b2 = nb::cast<Array<Scalar, nb::ndim<1>>>(arrays[4 * h + 3]);
    const size_t inputs = w1.shape(1), outputs = static_cast<size_t>(kOutputs[h] * k);
    const bool fits = w1.shape(0) == kHidden && (inputs == kFeatures + 3 || inputs == kFeatures + 4) &&
                      b1.shape(0) == kHidden && w2.shape(0) == outputs && w2.shape(1) == kHidden &&
                      b2.shape(0) == outputs;
    if (!fits) throw nb::value_error("a head must be [32, 35 or 36], [32], [outputs, 32], [outputs]");
    heads[h] = {w1.data(), b1.data(), w2.data(), b2.data(), static_cast<int>(inputs)};
  }
}

// The weights of twelve arrays in one piece.
Floats pack_weights(const nb::list& arrays, WeightLayout layout) {
  Head<const float> heads[kHeads];
  heads_of(arrays, layout.k, heads);
  Floats packed = make_floats(layout.size());
  std::fill_n(packed.get(), layout.size(), 0.0f);
  for_each_weight(layout, heads, [&](float weight, int place) { packed[place] = weight; });
  return packed;
}

// The first rows of a column, which the array owns from now on.
template <class T, class... Size>
auto hand_over(Column<T>& column, Size... shape) {
  T* const data = column.data();
  const nb::capsule owner(column.release(), [](void* memory) noexcept { std::free(memory); });
  return nb::ndarray<nb::numpy, T, nb::c_contig>(data, {shape...}, owner);
}

nb::tuple decode_forward(const AnchorTensors& tensors, const MaybeIndices& rows, const nb::list& weights,
                         const Rows<const float>& camera) {
  const AnchorArrays anchors = anchor_arrays(tensors, rows);
  const WeightLayout layout{anchors.k};
  const Floats packed = pack_weights(weights, layout);
  DecodedView view = [&] {
    const Camera seen_by = unpack_camera(camera.data());
    const nb::gil_scoped_release unlocked;
    return decode(anchors, layout, packed.get(), seen_by);
  }();
  const size_t m = view.count, two = 2, three = 3;
  return nb::make_tuple(hand_over(view.means_px, m, two), hand_over(view.conics, m, three), hand_over(view.depths, m),
                        hand_over(view.colors, m, three), hand_over(view.opacities, m), hand_over(view.volumes, m),
                        hand_over(view.source, m));
}

const float* data(const MaybeGradient& array) { return array ? array->data() : nullptr; }
float* data(const MaybeRows& array) { return array ? array->data() : nullptr; }

// Room for the gradients of the weights, and their way into the twelve arrays, if these are wanted.
class WeightGradients {
 public:
  WeightGradients(const std::optional<nb::list>& out, WeightLayout layout)
      : out_(out), layout_(layout), summed_(out ? make_floats(layout.size()) : nullptr) {}
  float* room() const { return summed_.get(); }
  void hand_over() const {
    if (!out_) return;
    Head<float> heads[kHeads];
    heads_of(*out_, layout_.k, heads);
    for_each_weight(layout_, heads, [&](float& gradient, int place) { gradient = summed_[place]; });
  }

 private:
  const std::optional<nb::list>& out_;
  WeightLayout layout_;
  Floats summed_;
};

void backward(const AnchorTensors& tensors, const nb::list& weights, const Rows<const float>& camera,
              const Rows<const int32_t>& source, const Rows<const float>& colors, const Rows<const float>& opacities,
              const std::array<MaybeGradient, 6>& gradients, const std::array<MaybeRows, 3>& out,
              const std::optional<nb::list>& weights_out) {
  const AnchorArrays anchors = anchor_arrays(tensors, std::nullopt);
  const WeightLayout layout{anchors.k};
  const Floats packed = pack_weights(weights, layout);
  const WeightGradients summed(weights_out, layout);
  const Camera view = unpack_camera(camera.data());
  const SplatGradients in = {data(gradients[0]), data(gradients[1]), data(gradients[2]), data(gradients[3]),
                             data(gradients[4]), data(gradients[5]), 0.0f, colors.data(), opacities.data(),
                             source.data(), static_cast<int64_t>(source.shape(0))};
  {
    const nb::gil_scoped_release unlocked;
    decode_backward(anchors, layout, packed.get(), view, in, {data(out[0]), data(out[1]), data(out[2])},
                    summed.room());
  }
  summed.hand_over();
}

AdamRows adam_rows(const StepArguments& arguments, int width) {
  const auto& [parameter, first, second, rates, roots, f] = arguments;
  const AdamStep step{rates.data(), roots.data(), static_cast<int64_t>(rates.size()), f[0], f[1], f[2]};
  return {parameter.data(), first.data(), second.data(), static_cast<size_t>(width), step};
}

bool backward_adam(const AnchorTensors& tensors, const Array<const int64_t>& rows, const nb::list& weights,
                   const Rows<const float>& camera, const Rows<const int32_t>& source,
                   const Rows<const float>& colors, const Rows<const float>& opacities,
                   const std::array<Rows<const float>, 4>& gradients, float volume,
                   const std::array<StepArguments, 3>& steps, const Rows<int32_t>& updates,
                   const std::optional<nb::list>& weights_out, const MaybeGradient& depths) {
  const AnchorArrays anchors = anchor_arrays(tensors, rows);
  const WeightLayout layout{anchors.k};
  const Floats packed = pack_weights(weights, layout);
  const WeightGradients summed(weights_out, layout);
  const Camera view = unpack_camera(camera.data());
  const SplatGradients in = {gradients[0].data(), gradients[1].data(), data(depths), gradients[2].data(),
                             gradients[3].data(), nullptr, volume, colors.data(), opacities.data(), source.data(),
                             static_cast<int64_t>(source.shape(0))};
  const AnchorSteps moves = {adam_rows(steps[0], kFeatures), adam_rows(steps[1], 3 * anchors.k),
                             adam_rows(steps[2], 6), updates.data()};
  bool finite;
  {
    const nb::gil_scoped_release unlocked;
    finite = decode_backward_adam(anchors, layout, packed.get(), view, in, moves, summed.room());
  }
  summed.hand_over();
  return finite;
}

}  // namespace
}  // namespace vdgs

VDGS_BIND(decode) {
  using namespace vdgs;
  m.def("decode", &decode_forward, nb::arg(), nb::arg().none(), nb::arg(), nb::arg());
  m.def("decode_backward", &backward, nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(),
        nb::arg(), nb::arg().none());
  m.def("decode_backward_adam", &backward_adam, nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(),
        nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg().none(),
        nb::arg("depths") = nb::none());
  m.attr("max_offsets") = kMaxOffsets;
}
