// How a scene fades out at its edge: of each point the k-th least share by which pictures would have to be larger to
// show it, over all cameras.
//
// Points come in blocks of neighbors. A camera whose widened picture does not reach a block's box is not looked at there;
// the others keep, sixteen points at a time, the k least shares in ascending order. Points are taken relative to the
// middle of the block, whose own place before each camera is computed in float64; where rounding in float32 could
// count, as near a camera or in a wide block, a point's share is computed again in float64.
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

// Rounding in float32 never fades what enough cameras hold: shares are so much smaller, in margins. It is no more.
constexpr float kRounding = 1e-5f;
// Bound on the error of a linear function in float32, in units of the largest that it is made of: coordinates, factors
// and constant are rounded once each (4 · 2^-24), the three fused steps once each.
constexpr double kFloatRounding = 8.0 / (1 << 24);

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

  // By how much it differs within the block from its constant, with a little for rounding.
  double reach(const Block& block) const {
    double sum = 0.0;
    for (int k = 0; k < 3; ++k) sum += std::abs(factor[k]) * block.half[k];
    return sum * (1.0 + 1e-12);
  }
  float doubt(const Block& block) const {
    return static_cast<float>(kFloatRounding * (std::abs(constant) + reach(block)));
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
  const ViewCamera& camera;
  Form x, y, z;
  double half_width, half_height;
  bool pinhole;
  float near;
  // Bounds on the errors of x or y, and of z.
  float doubt, z_doubt;

  BlockView(const ViewCamera& c, const Block& block)
      : camera(c), half_width(0.5 * c.width / longest(c)), half_height(0.5 * c.height / longest(c)),
        pinhole(c.orthographic == 0.0), near(static_cast<float>(c.near)) {
    const double right = (c.cx - 0.5 * c.width) / longest(c), below = (c.cy - 0.5 * c.height) / longest(c);
    z = form_of(c, block, 2, 1.0, 0.0);
    x = form_of(c, block, 0, c.fx / longest(c), pinhole ? 0.0 : right);
    y = form_of(c, block, 1, c.fy / longest(c), pinhole ? 0.0 : below);
    if (pinhole) x = sum(x, z, right), y = sum(y, z, below);
    doubt = std::max(x.doubt(block), y.doubt(block)), z_doubt = z.doubt(block);
  }

  // The share of a point, in float64.
  template <class Scalar>
  float exact(const Scalar* p) const {
    double local[3];
    for (int i = 0; i < 3; ++i) {
      const double* r = camera.rotation + 3 * i;
      local[i] = r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + camera.translation[i];
    }
    if (!(local[2] > camera.near)) return HUGE_VALF;
    const double divisor = pinhole ? local[2] : 1.0, unit = 1.0 / longest(camera);
    const double column = unit * (camera.fx * local[0] / divisor + camera.cx - 0.5 * camera.width);
    const double row = unit * (camera.fy * local[1] / divisor + camera.cy - 0.5 * camera.height);
    return static_cast<float>(std::max(std::abs(column) - half_width, std::abs(row) - half_height));
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

// How far points lie outside of a picture: 0 or less inside, infinite behind the camera. To `tolerance`, where no more
// than the margin lies between; only the first `size` points of the block count.
template <class Scalar>
VDGS_INLINE F16 outside(const BlockView& view, const Block& block, size_t i, const Scalar* own, size_t size,
                        float margin, float tolerance) {
  const F16 px = load(block.column[0] + i), py = load(block.column[1] + i), pz = load(block.column[2] + i);
  const F16 z = Form16(view.z).of(px, py, pz);
  F16 x = abs(Form16(view.x).of(px, py, pz)), y = abs(Form16(view.y).of(px, py, pz)), doubt = splat(view.doubt);
  if (view.pinhole) {
    const F16 nearness = exact_reciprocal(z);
    x = x * nearness, y = y * nearness;
    doubt = fma(max(x, y), splat(view.z_doubt), doubt) * nearness;
  }
  const F16 share = max(x - splat(static_cast<float>(view.half_width)), y - splat(static_cast<float>(view.half_height)));
  const F16 found = select(gt(z, splat(view.near)), share, splat(HUGE_VALF));
  // Beyond the margin, or well inside, an error changes nothing. What is not a number is in doubt.
  const M16 sure = le(abs(doubt), splat(tolerance)) | gt(share - abs(doubt), splat(margin)) |
                   lt(share + abs(doubt), splat(0.0f));
  const M16 in_front = gt(z - splat(view.near), splat(view.z_doubt)), behind = lt(z - splat(view.near), splat(-view.z_doubt));
  unsigned open = bits(~((in_front & sure) | behind)) & 0xffffu;
  if (!open) return found;
  alignas(64) float shares[kLanes];
  store(shares, found);
  for (; open; open &= open - 1) {
    const size_t lane = static_cast<size_t>(__builtin_ctz(open));
    if (i + lane < size) shares[lane] = view.exact(own + 3 * (i + lane));
  }
  return load(shares);
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
  const float tolerance = static_cast<float>(margin) * kRounding;
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
      for (const BlockView& view : views) {
        insert(least.data(), k, outside(view, block, i, own, size, static_cast<float>(margin), tolerance));
      }
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
