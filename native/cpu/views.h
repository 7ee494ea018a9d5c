// How many cameras see each point.
#pragma once

#include <cstddef>
#include <cstdint>

namespace vdgs {

// A camera in float64, in the order of this struct: rotation row-major.
struct ViewCamera {
  double rotation[9], translation[3], fx, fy, cx, cy, width, height, orthographic, near;
};

// count[i] = number of cameras with z > near and the projected centre of point i on the image, exactly as
// computed in float64. Points are [n, 3]; a point that is not finite is in no view.
template <class Scalar>
void count_views(const Scalar* points, size_t n, const ViewCamera* cameras, size_t n_cameras, int32_t* count);

}  // namespace vdgs
