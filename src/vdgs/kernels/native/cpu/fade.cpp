// How a scene fades out at its edge: of each point the k-th least share by which pictures would have to be larger to
// show it, over all cameras.
//
// Points come in blocks of neighbors. A camera whose widened picture does not reach a block's box is not looked at there;
// the others keep, sixteen points at a time, the k least shares in ascending order. Points are taken relative to the
// middle of the block, whose own place before each camera is computed in float64.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "bindings.h"
#include "cpu/view_camera.h"
#include "simd/simd.h"
#include "threads.h"

namespace vdgs {
namespace {

constexpr size_t kBlock = 512;

// Rounding in float32 never fades what enough cameras hold: shares are so much smaller, in margins.
constexpr float kRounding = 1e-5f;

// Points about the middle of their box, as columns. What is not finite sits in the middle.
struct Block {
  alignas(64) float column[3][kBlock];
  double center[3], half[3];
};

template <class Scalar>
bool finite(const Scalar* p) {
  return std::isfinite(p[0]) && std::isfinite(p[1]) && std::isfinite(p[2]);
}

template <class Scalar>
void fill(Block& block, const Scalar* points, size_t size) {
  for (int k = 0; k < 3; ++k) {
    double low = HUGE_VAL, high = -HUGE_VAL;
    for (size_t i = 0; i < size; ++i) {
      if (!finite(points + 3 * i)) continue;
      low = std::min<double>(low, points[3 * i + k]);
      high = std::max<double>(high, points[3 * i + k]);
    }
    const bool empty = low > high;
    block.center[k] = empty ? 0.0 : 0.5 * low + 0.5 * high;
    block.half[k] = empty ? 0.0 : 0.5 * high - 0.5 * low;
    std::fill(block.column[k], block.column[k] + kBlock, 0.0f);
    for (size_t i = 0; i < size; ++i) {
      if (finite(points + 3 * i)) block.column[k][i] = static_cast<float>(points[3 * i + k] - block.center[k]);
    }
  }
}

// A linear function of a point, about the middle of a block.
struct Form {
  double factor[3], constant;

  double reach(const Block& block) const {
    double sum = 0.0;
    for (int k = 0; k < 3; ++k) sum += std::abs(factor[k]) * block.half[k];
    return sum;
  }
};

// scale * (row of the pose) + constant, of a point of the block.
Form form_of(const ViewCamera& camera, const Block& block, int row, double scale, double constant) {
  Form form{};
  form.constant = scale * camera.translation[row] + constant;
  for (int k = 0; k < 3; ++k) {
    form.factor[k] = scale * camera.rotation[3 * row + k];
    form.constant += form.factor[k] * block.center[k];
  }
  return form;
}

Form sum(const Form& a, const Form& b, double times) {
  Form form{};
  for (int k = 0; k < 3; ++k) form.factor[k] = a.factor[k] + times * b.factor[k];
  form.constant = a.constant + times * b.constant;
  return form;
}

// Where a camera shows the points of a block: from the middle of its picture, in its longer sides, times the depth where
// it is a pinhole.
struct BlockView {
  Form x, y, z;
  double half_width, half_height;
  bool pinhole;
  float near;

  BlockView(const ViewCamera& c, const Block& block)
      : half_width(0.5 * c.width / longest(c)), half_height(0.5 * c.height / longest(c)),
        pinhole(c.orthographic == 0.0), near(static_cast<float>(c.near)) {
    const double right = (c.cx - 0.5 * c.width) / longest(c), below = (c.cy - 0.5 * c.height) / longest(c);
    z = form_of(c, block, 2, 1.0, 0.0);
    x = form_of(c, block, 0, c.fx / longest(c), pinhole ? 0.0 : right);
    y = form_of(c, block, 1, c.fy / longest(c), pinhole ? 0.0 : below);
    if (pinhole) x = sum(x, z, right), y = sum(y, z, below);
  }

  // Whether no point of the block's box is shown by a picture larger by `margin` on each side.
  bool misses(const Block& block, double margin) const {
    return z.constant + z.reach(block) <= near || beyond(block, x, half_width + margin) ||
           beyond(block, y, half_height + margin);
  }

 private:
  static double longest(const ViewCamera& c) { return std::max(c.width, c.height); }

  bool beyond(const Block& block, const Form& place, double limit) const {
    for (const double side : {1.0, -1.0}) {  // side * place > limit (* z) throughout
      Form over{};
      over = sum(over, place, side);
      if (pinhole) over = sum(over, z, -limit);
      else over.constant -= limit;
      if (over.constant > over.reach(block)) return true;
    }
    return false;
  }
};

// A linear function in float32.
struct Form16 {
  F16 factor[3], constant;
  explicit Form16(const Form& form) : constant(splat(static_cast<float>(form.constant))) {
    for (int k = 0; k < 3; ++k) factor[k] = splat(static_cast<float>(form.factor[k]));
  }
  VDGS_INLINE F16 of(F16 x, F16 y, F16 z) const {
    return fma(factor[0], x, fma(factor[1], y, fma(factor[2], z, constant)));
  }
};

// How far points lie outside of a picture: 0 or less inside, infinite behind the camera.
VDGS_INLINE F16 outside(const BlockView& view, const Block& block, size_t i) {
  const F16 px = load(block.column[0] + i), py = load(block.column[1] + i), pz = load(block.column[2] + i);
  const F16 z = Form16(view.z).of(px, py, pz);
  F16 x = abs(Form16(view.x).of(px, py, pz)), y = abs(Form16(view.y).of(px, py, pz));
  if (view.pinhole) {
    const F16 nearness = exact_reciprocal(z);
    x = x * nearness, y = y * nearness;
  }
  const F16 share = max(x - splat(static_cast<float>(view.half_width)), y - splat(static_cast<float>(view.half_height)));
  return select(gt(z, splat(view.near)), share, splat(HUGE_VALF));
}

// Puts a share among the k least, which ascend.
VDGS_INLINE void insert(float* least, size_t k, F16 share) {
  for (size_t j = 0; j < k; ++j) {
    const F16 there = loadu(least + j * kLanes);
    storeu(least + j * kLanes, min(there, share));
    share = max(there, share);
  }
}

template <class Scalar>
void fade(const Scalar* points, size_t n, const ViewCamera* cameras, size_t n_cameras, size_t k, double margin,
          float* factors) {
  parallel_for(static_cast<int64_t>((n + kBlock - 1) / kBlock), [&](int64_t task) {
    const size_t begin = static_cast<size_t>(task) * kBlock, size = std::min(kBlock, n - begin);
    const Scalar* own = points + 3 * begin;
    Block block;
    fill(block, own, size);
    std::vector<BlockView> views;
    for (size_t c = 0; c < n_cameras; ++c) {
      const BlockView view(cameras[c], block);
      if (!view.misses(block, margin)) views.push_back(view);
    }
    if (views.size() < k) return std::fill(factors + begin, factors + begin + size, 0.0f);
    std::vector<float> least(k * kLanes);
    for (size_t i = 0; i < size; i += kLanes) {
      std::fill(least.begin(), least.end(), HUGE_VALF);
      for (const BlockView& view : views) insert(least.data(), k, outside(view, block, i));
      const F16 share = loadu(least.data() + (k - 1) * kLanes) * splat(static_cast<float>(1.0 / margin));
      const F16 held = clamp(splat(1.0f + kRounding) - share, 0.0f, 1.0f);
      const int rest = static_cast<int>(std::min<size_t>(kLanes, size - i));
      store_first(factors + begin + i, rest, held * held * (splat(3.0f) - held - held));
    }
    for (size_t i = 0; i < size; ++i)
      if (!finite(own + 3 * i)) factors[begin + i] = 0.0f;
  });
}

template <class Scalar>
void bound(Array<const Scalar, nb::shape<-1, 3>> points, Array<const double, nb::shape<-1, kCameraNumbers>> cameras,
           size_t least, double margin, Array<float, nb::ndim<1>> factors) {
  nb::gil_scoped_release release;
  fade(points.data(), points.shape(0), reinterpret_cast<const ViewCamera*>(cameras.data()), cameras.shape(0), least,
       margin, factors.data());
}

}  // namespace

VDGS_BIND(fade_factors) {
  m.def("fade_factors", &bound<float>, nb::arg("points").noconvert(), nb::arg("cameras"), nb::arg("least"),
        nb::arg("margin"), nb::arg("factors"));
  m.def("fade_factors", &bound<double>, nb::arg("points").noconvert(), nb::arg("cameras"), nb::arg("least"),
        nb::arg("margin"), nb::arg("factors"));
}

}  // namespace vdgs
