// The mathematics of image formation (src/vdgs/kernels/shared/gaussian_math.h) for sixteen Gaussians at once.
#pragma once

#include "simd/simd.h"

#include "gaussian_math.h"

namespace vdgs {

template <>
struct Constant<F16> {
  static VDGS_FN F16 of(float a) { return splat(a); }
};

}  // namespace vdgs
