// Real spherical harmonics of sixteen directions: the functions of vdgs.kernels.spherical_harmonics.
#pragma once

#include <type_traits>

#include "simd/simd.h"

namespace vdgs {

constexpr int kMaxDegree = 3;

constexpr int functions(int degree) { return (degree + 1) * (degree + 1); }

template <int degree>
VDGS_INLINE void basis(F16 x, F16 y, F16 z, F16* out) {
  out[0] = splat(0.28209479177387814f);
  if constexpr (degree >= 1) {
    const F16 a = splat(-0.4886025119029199f);
    out[1] = a * y, out[2] = splat(0.4886025119029199f) * z, out[3] = a * x;
  }
  const F16 xx = x * x, yy = y * y, zz = z * z;
  if constexpr (degree >= 2) {
    const float a = 1.0925484305920792f;
    out[4] = splat(a) * x * y, out[5] = splat(-a) * y * z;
    out[6] = splat(0.31539156525252005f) * (splat(3.0f) * zz - splat(1.0f));
    out[7] = splat(-a) * x * z, out[8] = splat(0.5f * a) * (xx - yy);
  }
  if constexpr (degree >= 3) {
    const float a = 0.5900435899266435f, b = 2.890611442640554f, c = 0.4570457994644658f;
    const F16 five = splat(5.0f) * zz - splat(1.0f);
    out[9] = splat(-a) * y * (splat(3.0f) * xx - yy), out[10] = splat(b) * x * y * z, out[11] = splat(-c) * y * five;
    out[12] = splat(0.3731763325901154f) * z * (splat(5.0f) * zz - splat(3.0f));
    out[13] = splat(-c) * x * five, out[14] = splat(0.5f * b) * z * (xx - yy);
    out[15] = splat(-a) * x * (xx - splat(3.0f) * yy);
  }
}

// Calls body(std::integral_constant of the degree).
template <int degree = 0, class Body>
void with_degree(int wanted, const Body& body) {
  if (wanted == degree) return body(std::integral_constant<int, degree>{});
  if constexpr (degree < kMaxDegree) with_degree<degree + 1>(wanted, body);
}

}  // namespace vdgs
