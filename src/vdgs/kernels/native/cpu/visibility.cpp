// A frustum is five half-spaces: n·p + d > 0 for the near plane and the four borders of the image (for a
// pinhole x >= 0 says fx X + cx Z >= 0). Points come in blocks of neighbors; per block and camera
//
//   all corners of the block's box inside every half-space    -> one count for the whole block
//   all corners outside one half-space                        -> nothing
//   else                                                      -> sixteen points at a time in float32.
//
// Float32 is exact enough because points are taken relative to the block's center, whose own distance to
// each plane is computed in float64. What rounding could still decide, a point nearer to a plane than a bound
// on the error, is computed again in float64: the result is that of brute force in float64.
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
constexpr int kPlanes = 5;

// Bound on the error of n·p + d in float32, in units of (radius of the block + |d|), for |n| = 1: the
// coordinates, the normal and d are rounded once each (3 · 2^-24), the three fused steps once each.
constexpr double kRounding = 16.0 / (1 << 24);
// The same for what is computed in float64, in units of all that is added up.
constexpr double kExactRounding = 16.0 / (int64_t{1} << 53);
// Blocks that reach further than this could overflow in float32; they are computed in float64 throughout.
constexpr float kFar = 1e30f;

struct Plane {
  double normal[3], offset;
};

struct Frustum {
  Plane planes[kPlanes];
};

Plane plane_of(const ViewCamera& camera, double x, double y, double z, double constant) {
  Plane plane{};
  plane.offset = constant;
  double square = 0.0;
  for (int i = 0; i < 3; ++i) {
    const double* r = camera.rotation;
    plane.normal[i] = x * r[i] + y * r[3 + i] + z * r[6 + i];
    square += plane.normal[i] * plane.normal[i];
  }
  plane.offset += x * camera.translation[0] + y * camera.translation[1] + z * camera.translation[2];
  const double scale = 1.0 / std::sqrt(square);
  for (double& n : plane.normal) n *= scale;
  plane.offset *= scale;
  return plane;
}

Frustum frustum_of(const ViewCamera& c) {
  // For a pinhole the borders pass through the camera, for an orthographic view they are parallel to z.
  const double depth = c.orthographic != 0.0 ? 0.0 : 1.0, flat = 1.0 - depth;
  return {{plane_of(c, 0, 0, 1, -c.near), plane_of(c, c.fx, 0, c.cx * depth, c.cx * flat),
           plane_of(c, -c.fx, 0, (c.width - c.cx) * depth, (c.width - c.cx) * flat),
           plane_of(c, 0, c.fy, c.cy * depth, c.cy * flat),
           plane_of(c, 0, -c.fy, (c.height - c.cy) * depth, (c.height - c.cy) * flat)}};
}

// The definition, as geometry.camera.Camera.in_frustum has it.
bool sees(const ViewCamera& c, const double* p) {
  double local[3];
  for (int i = 0; i < 3; ++i) {
    const double* r = c.rotation + 3 * i;
    local[i] = r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + c.translation[i];
  }
  if (!(local[2] > c.near)) return false;
  const double divisor = c.orthographic != 0.0 ? 1.0 : local[2];
  const double x = c.fx * local[0] / divisor + c.cx, y = c.fy * local[1] / divisor + c.cy;
  return x >= 0.0 && x < c.width && y >= 0.0 && y < c.height;
}

// Points about their center, as columns.
struct Block {
  alignas(64) float column[3][kBlock];
  alignas(64) int32_t count[kBlock];
  double center[3], half[3], radius, magnitude;
  size_t size;
};

template <class Scalar>
bool finite(const Scalar* p) {
  return std::isfinite(p[0]) && std::isfinite(p[1]) && std::isfinite(p[2]);
}

// A point that is not finite, and the filling after the last, sit at the center and their counts are ignored.
template <class Scalar>
void fill(Block& block, const Scalar* points, size_t size) {
  double low[3], high[3];
  std::fill(low, low + 3, HUGE_VAL);
  std::fill(high, high + 3, -HUGE_VAL);
  for (size_t i = 0; i < size; ++i) {
    if (!finite(points + 3 * i)) continue;
    for (int k = 0; k < 3; ++k) {
      low[k] = std::min<double>(low[k], points[3 * i + k]);
      high[k] = std::max<double>(high[k], points[3 * i + k]);
    }
  }
  block.size = size;
  block.radius = block.magnitude = 0.0;
  for (int k = 0; k < 3; ++k) {
    const bool empty = low[k] > high[k];
    block.center[k] = empty ? 0.0 : 0.5 * low[k] + 0.5 * high[k];
    block.half[k] = empty ? 0.0 : 0.5 * high[k] - 0.5 * low[k];
    block.radius += block.half[k];
    block.magnitude += std::abs(block.center[k]) + block.half[k];
  }
  for (int k = 0; k < 3; ++k) {
    std::fill(block.column[k], block.column[k] + kBlock, 0.0f);
    for (size_t i = 0; i < size; ++i) {
      if (finite(points + 3 * i)) block.column[k][i] = static_cast<float>(points[3 * i + k] - block.center[k]);
    }
  }
  std::fill(block.count, block.count + kBlock, 0);
}

enum class Side { kInside, kOutside, kCut };

// The planes that cut the block, about its center and rounded, with the bound on their error.
struct Cut {
  float normal[kPlanes][3], offset[kPlanes];
  float doubt = 0.0f;
  int planes = 0;
};

Side cut_block(const Block& block, const Frustum& frustum, Cut& cut) {
  for (const Plane& plane : frustum.planes) {
    double distance = plane.offset, reach = 0.0;
    for (int k = 0; k < 3; ++k) {
      distance += plane.normal[k] * block.center[k];
      reach += std::abs(plane.normal[k]) * block.half[k];
    }
    const double doubt = kRounding * (block.radius + std::abs(distance)) +
                         kExactRounding * (block.magnitude + std::abs(plane.offset));
    if (distance < -reach - doubt) return Side::kOutside;
    if (distance > reach + doubt) continue;
    for (int k = 0; k < 3; ++k) cut.normal[cut.planes][k] = static_cast<float>(plane.normal[k]);
    cut.offset[cut.planes++] = static_cast<float>(distance);
    cut.doubt = std::max(cut.doubt, static_cast<float>(doubt));
  }
  return cut.planes ? Side::kCut : Side::kInside;
}

template <class Scalar>
void count_exact(Block& block, size_t at, const ViewCamera& camera, const Scalar* points) {
  const double exact[3] = {points[3 * at], points[3 * at + 1], points[3 * at + 2]};
  block.count[at] += sees(camera, exact);
}

template <class Scalar>
void count_cut(Block& block, const Cut& cut, const ViewCamera& camera, const Scalar* points) {
  if (!(cut.doubt < kFar)) {
    for (size_t at = 0; at < block.size; ++at) count_exact(block, at, camera, points);
    return;
  }
  for (size_t i = 0; i < block.size; i += kLanes) {
    const F16 x = load(block.column[0] + i), y = load(block.column[1] + i), z = load(block.column[2] + i);
    F16 nearest = splat(HUGE_VALF);
    for (int p = 0; p < cut.planes; ++p) {
      const float* n = cut.normal[p];
      nearest = min(nearest, fma(splat(n[0]), x, fma(splat(n[1]), y, fma(splat(n[2]), z, splat(cut.offset[p])))));
    }
    const F16 doubt = splat(cut.doubt);
    const M16 inside = gt(nearest, doubt);
    // The bits of 1.0f are 127 << 23: their lowest set bit, moved down, is the integer one.
    const I16 one = shift_right<23>(bits_of(zero_unless(inside, splat(1.0f)))) & splat(int32_t{1});
    store(block.count + i, load(block.count + i) + one);
    for (unsigned open = bits(le(abs(nearest), doubt)); open; open &= open - 1) {
      const size_t at = i + static_cast<size_t>(__builtin_ctz(open));
      if (at < block.size) count_exact(block, at, camera, points);
    }
  }
}

template <class Scalar>
void count_visibility(const Scalar* points, size_t n, const ViewCamera* cameras, size_t n_cameras, int32_t* count) {
  std::vector<Frustum> frusta(n_cameras);
  for (size_t i = 0; i < n_cameras; ++i) frusta[i] = frustum_of(cameras[i]);
  parallel_for(static_cast<int64_t>((n + kBlock - 1) / kBlock), [&](int64_t task) {
    const size_t begin = static_cast<size_t>(task) * kBlock, size = std::min(kBlock, n - begin);
    const Scalar* own = points + 3 * begin;
    Block block;
    fill(block, own, size);
    int32_t by_all = 0;
    for (size_t i = 0; i < n_cameras; ++i) {
      Cut cut;
      const Side side = cut_block(block, frusta[i], cut);
      by_all += side == Side::kInside;
      if (side == Side::kCut) count_cut(block, cut, cameras[i], own);
    }
    for (size_t i = 0; i < size; ++i) count[begin + i] = finite(own + 3 * i) ? block.count[i] + by_all : 0;
  });
}

template <class Scalar>
void bound(Array<const Scalar, nb::shape<-1, 3>> points, Array<const double, nb::shape<-1, kCameraNumbers>> cameras,
           Array<int32_t, nb::ndim<1>> count) {
  nb::gil_scoped_release release;
  count_visibility(points.data(), points.shape(0), reinterpret_cast<const ViewCamera*>(cameras.data()), cameras.shape(0),
              count.data());
}

}  // namespace

VDGS_BIND(count_visibility) {
  m.def("count_visibility", &bound<float>, nb::arg("points").noconvert(), nb::arg("cameras"), nb::arg("count"));
  m.def("count_visibility", &bound<double>, nb::arg("points").noconvert(), nb::arg("cameras"), nb::arg("count"));
}

}  // namespace vdgs
