// Growth's statistics of one view: what each offset's gradient was, what each anchor's opacity.
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "bindings.h"
#include "threads.h"

namespace vdgs {
namespace {

constexpr int64_t kTaskAnchors = 512;

struct View {
  const int64_t* visible;
  const uint8_t* inside;  // of each visible anchor: whether it counts as seen
  const int32_t* source;
  const float* opacities;
  const float* gradient_px;
  float half_width, half_height;
};

struct Sums {
  float *gradient, *drawn, *opacity, *seen;
  int64_t offsets;
};

// The visible anchors [begin, end). Sources ascend, so that an anchor's splats lie together and belong to one task.
void add_anchors(const View& view, const Sums& sums, int64_t splats, int64_t begin, int64_t end) {
  const int64_t k = sums.offsets;
  const int32_t* source_end = view.source + splats;
  int64_t splat = std::lower_bound(view.source, source_end, begin * k) - view.source;
  for (int64_t row = begin; row < end; ++row) {
    const int64_t anchor = view.visible[row];
    float opacity = 0.0f;
    for (; splat < splats && view.source[splat] < (row + 1) * k; ++splat) {
      const int64_t slot = anchor * k + (view.source[splat] - row * k);
      const float x = view.gradient_px[2 * splat] * view.half_width;
      const float y = view.gradient_px[2 * splat + 1] * view.half_height;
      sums.gradient[slot] += std::sqrt(x * x + y * y);
      sums.drawn[slot] += 1.0f;
      opacity += view.opacities[splat];
    }
    sums.opacity[anchor] += opacity;
    sums.seen[anchor] += view.inside[row] ? 1.0f : 0.0f;
  }
}

using Vector = Array<float, nb::ndim<1>>;
using Matrix = Array<float, nb::ndim<2>>;

void bound(Array<const int64_t, nb::ndim<1>> visible, Array<const uint8_t, nb::ndim<1>> inside,
           Array<const int32_t, nb::ndim<1>> source, Array<const float, nb::ndim<1>> opacities,
           Array<const float, nb::ndim<2>> gradient_px, float half_width, float half_height, Matrix gradient,
           Matrix drawn, Vector opacity, Vector seen) {
  nb::gil_scoped_release release;
  const View view{visible.data(),   inside.data(), source.data(), opacities.data(), gradient_px.data(),
                  half_width, half_height};
  const Sums sums{gradient.data(), drawn.data(), opacity.data(), seen.data(), static_cast<int64_t>(gradient.shape(1))};
  const int64_t anchors = static_cast<int64_t>(visible.shape(0)), splats = static_cast<int64_t>(source.shape(0));
  parallel_for((anchors + kTaskAnchors - 1) / kTaskAnchors, [&](int64_t task) {
    const int64_t begin = task * kTaskAnchors;
    add_anchors(view, sums, splats, begin, std::min(anchors, begin + kTaskAnchors));
  });
}

}  // namespace

VDGS_BIND(add_view_statistics) {
  m.def("add_view_statistics", &bound, nb::arg("visible"), nb::arg("inside"), nb::arg("source"), nb::arg("opacities"),
        nb::arg("gradient_px"), nb::arg("half_width"), nb::arg("half_height"), nb::arg("gradient"), nb::arg("drawn"),
        nb::arg("opacity"), nb::arg("seen"));
}

}  // namespace vdgs
