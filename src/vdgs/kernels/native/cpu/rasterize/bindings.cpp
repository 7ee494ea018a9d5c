// The rasterizer as Python sees it. Shapes and types are checked by vdgs.kernels.cpu.rasterize.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/shared_ptr.h>

#include <cmath>
#include <vector>

#include "bindings.h"
#include "cpu/rasterize/frame.h"

namespace {

using namespace vdgs::raster;
using Floats = vdgs::Array<const float>;
using MutableFloats = vdgs::Array<float>;

// Frames that nobody uses, for their memory: asking the system for it again costs more than drawing a
// small picture. At most two, and no more than a gigabyte.
std::mutex idle_mutex;
std::vector<Frame*>& idle_frames() {
  static auto* frames = new std::vector<Frame*>;  // never destroyed: frames may outlive the module
  return *frames;
}
constexpr size_t kIdleFrames = 2, kIdleBytes = size_t{1} << 30;

void recycle(Frame* frame) {
  std::unique_ptr<Frame> owned(frame);
  const std::lock_guard<std::mutex> lock(idle_mutex);
  size_t held = owned->bytes();
  for (const Frame* f : idle_frames()) held += f->bytes();
  if (idle_frames().size() < kIdleFrames && held <= kIdleBytes) idle_frames().push_back(owned.release());
}

std::shared_ptr<Frame> take_frame() {
  const std::lock_guard<std::mutex> lock(idle_mutex);
  Frame* frame;
  if (idle_frames().empty()) {
    frame = new Frame;
  } else {
    frame = idle_frames().back();
    idle_frames().pop_back();
  }
  return std::shared_ptr<Frame>(frame, recycle);
}

void drop_idle_frames() {
  const std::lock_guard<std::mutex> lock(idle_mutex);
  for (Frame* frame : idle_frames()) delete frame;
  idle_frames().clear();
}

std::shared_ptr<Frame> py_forward(Floats means, Floats conics, Floats colors, Floats opacities,
                                  Floats depths, const nb::tuple& background, int width, int height,
                                  MutableFloats image, MutableFloats alpha,
                                  std::optional<MutableFloats> depth,
                                  std::optional<MutableFloats> median_depth, bool counting) {
  const Splats splats{static_cast<int64_t>(opacities.shape(0)),
                      means.data(),
                      conics.data(),
                      colors.data(),
                      opacities.data(),
                      depths.data()};
  const Picture out{image.data(), alpha.data(), depth ? depth->data() : nullptr,
                    median_depth ? median_depth->data() : nullptr};
  float back[3];
  for (size_t c = 0; c < 3; ++c) back[c] = nb::cast<float>(background[c]);
  auto frame = take_frame();  // with the GIL held: a fork never finds idle_mutex locked
  const nb::gil_scoped_release released;
  forward(*frame, splats, back, width, height, out, counting);
  return frame;
}

void py_backward(std::shared_ptr<Frame> frame, const nb::tuple& background, std::optional<Floats> image,
                 std::optional<Floats> alpha, std::optional<Floats> depth, MutableFloats means,
                 MutableFloats conics, MutableFloats colors, MutableFloats opacities,
                 std::optional<MutableFloats> depths, MutableFloats background_gradient) {
  const auto pointer = [](const std::optional<Floats>& a) { return a ? a->data() : nullptr; };
  const PictureGradients in{pointer(image), pointer(alpha), pointer(depth)};
  const SplatGradients out{static_cast<int64_t>(opacities.shape(0)),
                           means.data(),
                           conics.data(),
                           colors.data(),
                           opacities.data(),
                           depths ? depths->data() : nullptr,
                           background_gradient.data()};
  float back[3];
  for (size_t c = 0; c < 3; ++c) back[c] = nb::cast<float>(background[c]);
  const nb::gil_scoped_release released;
  backward(*frame, back, in, out);
}

void py_shares(std::shared_ptr<Frame> frame, Floats lacking, MutableFloats pixels, MutableFloats missing) {
  const nb::gil_scoped_release released;
  shares(*frame, lacking.data(), pixels.data(), missing.data());
}

nb::dict seconds(const Frame& frame) {
  static const char* const names[] = {"cull", "select", "bin", "scatter", "forward", "backward", "reduce"};
  nb::dict out;
  for (size_t i = 0; i < 7; ++i) out[names[i]] = frame.seconds[i];
  return out;
}

nb::dict statistics(const Frame& frame) {
  nb::dict out;
  out["candidates"] = frame.stats.candidates;
  out["sorted"] = frame.stats.sorted;
  out["entries"] = frame.stats.entries;
  out["visited"] = frame.stats.visited;
  out["pairs"] = frame.stats.pairs;
  out["slabs"] = frame.n_slabs;
  return out;
}

}  // namespace

VDGS_BIND(rasterize) {
  nb::class_<Frame>(m, "Frame", "A drawn picture, as its backward pass needs it.")
      .def_prop_ro("bytes", &Frame::bytes, "Memory that it holds on to.")
      .def_prop_ro("seconds", &seconds, "How long each phase took.")
      .def_prop_ro("statistics", &statistics, "Counts of a picture drawn with counting=True.");
  m.attr("ALPHA_MIN") = std::exp2(vdgs::kLog2AlphaMin);
  m.attr("ALPHA_MAX") = vdgs::kAlphaMax;
  m.attr("TRANSMITTANCE_MIN") = vdgs::kTransmittanceMin;
  m.attr("MEDIAN_TRANSMITTANCE") = vdgs::kMedianTransmittance;
  m.def("rasterize_forward", &py_forward, nb::arg("means"), nb::arg("conics"), nb::arg("colors"),
        nb::arg("opacities"), nb::arg("depths"), nb::arg("background"), nb::arg("width"), nb::arg("height"),
        nb::arg("image"), nb::arg("alpha"), nb::arg("depth").none(), nb::arg("median_depth").none(),
        nb::arg("counting") = false);
  m.def("rasterize_backward", &py_backward, nb::arg("frame"), nb::arg("background"), nb::arg("image").none(),
        nb::arg("alpha").none(), nb::arg("depth").none(), nb::arg("means"), nb::arg("conics"),
        nb::arg("colors"), nb::arg("opacities"), nb::arg("depths").none(), nb::arg("background_gradient"));
  m.def("rasterize_shares", &py_shares, nb::arg("frame"), nb::arg("lacking"), nb::arg("pixels"),
        nb::arg("missing"));
  m.def("drop_idle_frames", &drop_idle_frames, "Gives the memory of frames that are not in use back.");
}
