// A camera as visibility is counted with it.
#pragma once

#include <cstddef>

namespace vdgs {

// In float64, in the order of Camera.packed_float64; the rotation is row-major.
struct ViewCamera {
  double rotation[9], translation[3], fx, fy, cx, cy, width, height, orthographic, near;
};
constexpr size_t kCameraNumbers = sizeof(ViewCamera) / sizeof(double);

}  // namespace vdgs
