// The mathematics of image formation, written once: the projection of a Gaussian, what an anchor
// spawns, and their derivatives.
//
// Every function is a template over the scalar T: `float` for one Gaussian, or a vector of the processor's that
// brings the operations below with it (native/gaussian.h: sixteen at once). No containers, no exceptions, no
// standard library beyond scalar functions, so that the same text compiles for a GPU. The torch twins in
// src/vdgs/kernels/torch_ref are the oracle.
#pragma once

#if defined(__CUDACC__) || defined(__CUDACC_RTC__)
#define VDGS_FN __host__ __device__ __forceinline__
#else
#define VDGS_FN inline __attribute__((always_inline))
#include <math.h>
#endif

#include "image_formation.h"

namespace vdgs {

// The operations of a scalar, for a plain float.
VDGS_FN float fma(float a, float b, float c) { return a * b + c; }
VDGS_FN float sqrt(float a) { return ::sqrtf(a); }
VDGS_FN float abs(float a) { return ::fabsf(a); }
VDGS_FN float exp(float a) { return ::expf(a); }
VDGS_FN float log(float a) { return ::logf(a); }
VDGS_FN float min(float a, float b) { return a < b ? a : b; }
VDGS_FN float max(float a, float b) { return a > b ? a : b; }
VDGS_FN bool lt(float a, float b) { return a < b; }
VDGS_FN bool le(float a, float b) { return a <= b; }
VDGS_FN bool gt(float a, float b) { return a > b; }
VDGS_FN float select(bool m, float a, float b) { return m ? a : b; }
VDGS_FN float zero_unless(bool m, float a) { return m ? a : 0.0f; }
VDGS_FN float sigmoid(float a) { return 1.0f / (1.0f + ::expf(-a)); }

template <class T>
struct Constant;
template <>
struct Constant<float> {
  static VDGS_FN float of(float a) { return a; }
};
template <class T>
VDGS_FN T constant(float a) {
  return Constant<T>::of(a);
}
template <class T>
using Mask = decltype(lt(T(), T()));

template <class T>
struct Vec3 {
  T x, y, z;
};
template <class T>
struct Quaternion {
  T w, x, y, z;
};
// Columns of a 3x3 matrix.
template <class T>
struct Columns {
  Vec3<T> a, b, c;
};

template <class T>
VDGS_FN Vec3<T> operator+(Vec3<T> a, Vec3<T> b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <class T>
VDGS_FN Vec3<T> operator*(T s, Vec3<T> a) {
  return {s * a.x, s * a.y, s * a.z};
}
template <class T>
VDGS_FN T dot(Vec3<T> a, Vec3<T> b) {
  return fma(a.x, b.x, fma(a.y, b.y, a.z * b.z));
}
template <class T>
VDGS_FN Vec3<T> cross(Vec3<T> a, Vec3<T> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class T>
VDGS_FN Mask<T> finite(T a) {
  return le(abs(a), constant<T>(3.402823466e38f));
}

// ---------------------------------------------------------------------------------------- camera

// A pinhole or orthographic view. `limit` bounds x/z and y/z in the Jacobian of the projection.
struct Camera {
  Vec3<float> right, down, forward;  // rows of the rotation camera_from_world
  Vec3<float> center;
  float fx, fy, cx, cy, width, height, near;
  float limit_x, limit_y;
  float blur;  // least variance of the blur, px^2 at depth one
  bool orthographic;
};

// From vdgs.geometry.camera.Camera.packed: rotation (9), translation (3), fx, fy, cx, cy, width, height,
// orthographic, near, width and height of the whole picture, size of a photograph's pixel. A part of a picture has the
// limits of the whole one: else it would not show what that does.
VDGS_FN Camera unpack_camera(const float* p) {
  Camera camera;
  camera.right = {p[0], p[1], p[2]};
  camera.down = {p[3], p[4], p[5]};
  camera.forward = {p[6], p[7], p[8]};
  float* center[3] = {&camera.center.x, &camera.center.y, &camera.center.z};
  for (int i = 0; i < 3; ++i) {
    double sum = 0.0;
    for (int row = 0; row < 3; ++row) sum -= static_cast<double>(p[3 * row + i]) * p[9 + row];
    *center[i] = static_cast<float>(sum);
  }
  camera.fx = p[12], camera.fy = p[13], camera.cx = p[14], camera.cy = p[15];
  camera.width = p[16], camera.height = p[17];
  camera.orthographic = p[18] != 0.0f;
  camera.near = p[19];
  camera.limit_x = kFrustumMargin * 0.5f * p[20] / camera.fx;
  camera.limit_y = kFrustumMargin * 0.5f * p[21] / camera.fy;
  camera.blur = kDilationPx2 * p[22] * p[22] * camera.fx * camera.fy;
  return camera;
}

template <class T>
VDGS_FN Vec3<T> constant(Vec3<float> a) {
  return {constant<T>(a.x), constant<T>(a.y), constant<T>(a.z)};
}
// World to camera. Differences to the center first: far from the origin they keep their precision.
template <class T>
VDGS_FN Vec3<T> into_camera(const Camera& camera, Vec3<T> point) {
  const Vec3<T> center = constant<T>(camera.center);
  const Vec3<T> ray = {point.x - center.x, point.y - center.y, point.z - center.z};
  return {dot(constant<T>(camera.right), ray), dot(constant<T>(camera.down), ray),
          dot(constant<T>(camera.forward), ray)};
}

// ---------------------------------------------------------------------------------------- rotation

template <class T>
VDGS_FN Columns<T> rotation_of(Quaternion<T> q) {
  const T one = constant<T>(1.0f), two = constant<T>(2.0f);
  return {{one - two * (q.y * q.y + q.z * q.z), two * (q.x * q.y + q.w * q.z), two * (q.x * q.z - q.w * q.y)},
          {two * (q.x * q.y - q.w * q.z), one - two * (q.x * q.x + q.z * q.z), two * (q.y * q.z + q.w * q.x)},
          {two * (q.x * q.z + q.w * q.y), two * (q.y * q.z - q.w * q.x), one - two * (q.x * q.x + q.y * q.y)}};
}

// Gradient of a unit quaternion from that of its rotation matrix.
template <class T>
VDGS_FN Quaternion<T> rotation_gradient(Quaternion<T> q, const Columns<T>& g) {
  const T two = constant<T>(2.0f);
  const T xy = g.b.x + g.a.y, xz = g.c.x + g.a.z, yz = g.c.y + g.b.z;
  const T wx = g.b.z - g.c.y, wy = g.c.x - g.a.z, wz = g.a.y - g.b.x;
  return {two * (q.x * wx + q.y * wy + q.z * wz),
          two * (q.y * xy + q.z * xz + q.w * wx - two * q.x * (g.b.y + g.c.z)),
          two * (q.x * xy + q.z * yz + q.w * wy - two * q.y * (g.a.x + g.c.z)),
          two * (q.x * xz + q.y * yz + q.w * wz - two * q.z * (g.a.x + g.b.y))};
}

// ---------------------------------------------------------------------------------------- culling

// What is added to the variances of a Gaussian: that of a pixel of the view, or of a photograph where that is larger.
template <class T>
VDGS_FN T dilation_of(const Camera& camera, T inverse_z) {
  return max(constant<T>(kDilationPx2), constant<T>(camera.blur) * inverse_z * inverse_z);
}

// Along one side of the image: the squared distance in px of a center from 0 .. size, and the factor (squared) from
// world to px at its bound.
template <class T>
struct Reach {
  T outside_squared, stretch;
};

template <class T>
VDGS_FN Reach<T> reach_of(float focal, float center, float size, float limit, T position, T inverse_z,
                          bool orthographic) {
  const T zero = constant<T>(0.0f);
  const T slope = position * inverse_z;
  const T pixel = fma(constant<T>(focal), slope, constant<T>(center));
  const T outside = max(max(zero - pixel, pixel - constant<T>(size)), zero);
  const T bounded = orthographic ? zero : min(abs(slope), constant<T>(limit));
  const T scale = constant<T>(focal) * inverse_z;
  return {outside * outside, scale * scale * fma(bounded, bounded, constant<T>(1.0f))};
}

// Where a center lies beside the image; the bound is explained in src/vdgs/kernels/torch_ref/cull.py.
template <class T>
struct Sight {
  Reach<T> x, y;
  Mask<T> before;  // the camera
  T least;         // 3 sigma of the dilation, squared

  // Whether a Gaussian of any size is kept: the dilation alone reaches the image.
  VDGS_FN Mask<T> surely() const {
    return before & le(x.outside_squared, least) & le(y.outside_squared, least);
  }
  // Whether one is kept whose largest scale is exp(log_scale).
  VDGS_FN Mask<T> holds(T log_scale) const {
    const T reach = constant<T>(9.0f) * exp(constant<T>(2.0f) * log_scale);
    return before & le(x.outside_squared, fma(reach, x.stretch, least)) &
           le(y.outside_squared, fma(reach, y.stretch, least));
  }
};

// Of a center in the camera's axes.
template <class T>
VDGS_FN Sight<T> sight_of(const Camera& camera, Vec3<T> local) {
  const T inverse_z = camera.orthographic ? constant<T>(1.0f) : constant<T>(1.0f) / local.z;
  return {reach_of(camera.fx, camera.cx, camera.width, camera.limit_x, local.x, inverse_z, camera.orthographic),
          reach_of(camera.fy, camera.cy, camera.height, camera.limit_y, local.y, inverse_z, camera.orthographic),
          gt(local.z, constant<T>(camera.near)), constant<T>(9.0f) * dilation_of(camera, inverse_z)};
}

// ---------------------------------------------------------------------------------------- projection

template <class T>
struct Gaussian {
  Vec3<T> mean, scale;
  Quaternion<T> quaternion;  // of any length but zero
};

// A Gaussian on the image: what is drawn, or the gradient of what is drawn.
template <class T>
struct Footprint {
  T x, y, depth;
  T conic_xx, conic_xy, conic_yy;
};

// A projected Gaussian, and everything that its derivative needs again.
template <class T>
struct Projection {
  Footprint<T> drawn;
  T variance_x, variance_y;  // dilated, px^2
  Mask<T> valid;

  Vec3<T> local;
  T inverse_z;               // one for an orthographic camera
  T dilation;                // of the variances, px^2
  T u, v;                    // clamped x/z and y/z
  Mask<T> u_moves, v_moves;  // where the clamp lets them follow
  Quaternion<T> unit;
  T inverse_length;
  Columns<T> rotation;  // of the Gaussian; its columns times the scales are the semi-axes
  Vec3<T> toward_x, toward_y;  // rows of J W
  Vec3<T> axes_x, axes_y;      // rows of J W R S
  Vec3<T> area;                // their cross product
  T inverse_determinant;       // of the dilated covariance
};

// The row f/z (axis - slope * forward) of J W.
template <class T>
VDGS_FN Vec3<T> jacobian_row(float focal, T inverse_z, T slope, Vec3<float> axis, Vec3<float> forward) {
  const T stretch = constant<T>(focal) * inverse_z;
  return stretch * (constant<T>(axis) + (constant<T>(0.0f) - slope) * constant<T>(forward));
}

// Pixel position, depth, and the rows of J W at the mean.
template <class T>
VDGS_FN void project_mean(const Camera& camera, Vec3<T> mean, Projection<T>& p) {
  const T zero = constant<T>(0.0f);
  p.local = into_camera(camera, mean);
  p.u = p.v = zero;
  p.u_moves = p.v_moves = lt(zero, zero);
  p.inverse_z = constant<T>(1.0f);
  T slope_x = p.local.x, slope_y = p.local.y;
  if (!camera.orthographic) {
    p.inverse_z = constant<T>(1.0f) / p.local.z;
    slope_x = p.local.x * p.inverse_z, slope_y = p.local.y * p.inverse_z;
    const T limit_x = constant<T>(camera.limit_x), limit_y = constant<T>(camera.limit_y);
    p.u = min(max(slope_x, zero - limit_x), limit_x);
    p.v = min(max(slope_y, zero - limit_y), limit_y);
    p.u_moves = lt(abs(slope_x), limit_x);
    p.v_moves = lt(abs(slope_y), limit_y);
  }
  p.drawn.x = fma(constant<T>(camera.fx), slope_x, constant<T>(camera.cx));
  p.drawn.y = fma(constant<T>(camera.fy), slope_y, constant<T>(camera.cy));
  p.drawn.depth = p.local.z;
  p.toward_x = jacobian_row(camera.fx, p.inverse_z, p.u, camera.right, camera.forward);
  p.toward_y = jacobian_row(camera.fy, p.inverse_z, p.v, camera.down, camera.forward);
}

// 3DGS, eq. 5, with the dilation d (0.3 px^2 or more) on the diagonal. The determinant of A A^T + d is taken as
// |x cross y|^2 + d (x.x + y.y) + d^2 for the rows x, y of A: no difference of large numbers.
template <class T>
VDGS_FN Projection<T> project(const Camera& camera, const Gaussian<T>& g) {
  Projection<T> p;
  project_mean(camera, g.mean, p);
  const Quaternion<T> q = g.quaternion;
  p.inverse_length = constant<T>(1.0f) / sqrt(fma(q.w, q.w, fma(q.x, q.x, fma(q.y, q.y, q.z * q.z))));
  p.unit = {q.w * p.inverse_length, q.x * p.inverse_length, q.y * p.inverse_length, q.z * p.inverse_length};
  p.rotation = rotation_of(p.unit);
  p.axes_x = {dot(p.toward_x, p.rotation.a) * g.scale.x, dot(p.toward_x, p.rotation.b) * g.scale.y,
              dot(p.toward_x, p.rotation.c) * g.scale.z};
  p.axes_y = {dot(p.toward_y, p.rotation.a) * g.scale.x, dot(p.toward_y, p.rotation.b) * g.scale.y,
              dot(p.toward_y, p.rotation.c) * g.scale.z};
  const T xx = dot(p.axes_x, p.axes_x), yy = dot(p.axes_y, p.axes_y), xy = dot(p.axes_x, p.axes_y);
  p.area = cross(p.axes_x, p.axes_y);
  const T dilation = dilation_of(camera, p.inverse_z);
  p.dilation = dilation;
  const T inverse = constant<T>(1.0f) / (dot(p.area, p.area) + dilation * (xx + yy + dilation));
  p.inverse_determinant = inverse;
  p.variance_x = xx + dilation, p.variance_y = yy + dilation;
  p.drawn.conic_xx = p.variance_y * inverse;
  p.drawn.conic_xy = constant<T>(0.0f) - xy * inverse;
  p.drawn.conic_yy = p.variance_x * inverse;
  const T zero = constant<T>(0.0f);
  p.valid = gt(p.local.z, constant<T>(camera.near)) & finite(p.local.z) & finite(p.drawn.x) & finite(p.drawn.y) &
            gt(p.drawn.conic_xx, zero) & gt(p.drawn.conic_yy, zero) & finite(p.drawn.conic_xx) &
            finite(p.drawn.conic_xy) & finite(p.drawn.conic_yy);
  return p;
}

// Gradients of the rows x, y of A = J W R S from the gradient G of the conic K = (A A^T + d)^-1:
// -2 K G (K A). With n = x cross y, the rows of K A are (d x + y cross n) and (d y - x cross n) over
// the determinant: for a needle seen lengthwise, the product of K and A would be all rounding.
template <class T>
VDGS_FN void conic_gradient(const Projection<T>& p, const Footprint<T>& g, Vec3<T>& axes_x, Vec3<T>& axes_y) {
  const T a = p.drawn.conic_xx, b = p.drawn.conic_xy, c = p.drawn.conic_yy;
  const T d = p.dilation;
  const T scale = constant<T>(-2.0f) * p.inverse_determinant;
  const Vec3<T> ka_x = scale * (d * p.axes_x + cross(p.axes_y, p.area));
  const Vec3<T> ka_y = scale * (d * p.axes_y + cross(p.area, p.axes_x));
  const T half = constant<T>(0.5f) * g.conic_xy;
  const Vec3<T> gka_x = g.conic_xx * ka_x + half * ka_y, gka_y = half * ka_x + g.conic_yy * ka_y;
  axes_x = a * gka_x + b * gka_y;
  axes_y = b * gka_x + c * gka_y;
}

// Gradient of the depth through a dilation above that of a pixel, which is 1 / z^2 times a constant: that of the
// dilation is -tr(K G K).
template <class T>
VDGS_FN T blur_gradient(const Projection<T>& p, const Footprint<T>& g) {
  const T a = p.drawn.conic_xx, b = p.drawn.conic_xy, c = p.drawn.conic_yy;
  const T by_dilation = g.conic_xx * (a * a + b * b) + g.conic_xy * b * (a + c) + g.conic_yy * (b * b + c * c);
  return zero_unless(gt(p.dilation, constant<T>(kDilationPx2)),
                     constant<T>(2.0f) * p.dilation * p.inverse_z * by_dilation);
}

// Gradient of one semi-axis (a column of the rotation times its scale) from those of its two images.
template <class T>
VDGS_FN Vec3<T> semi_axis_gradient(const Projection<T>& p, T along_x, T along_y) {
  return along_x * p.toward_x + along_y * p.toward_y;
}

// Gradient of the mean from those of pixel, depth and the rows of J W.
template <class T>
VDGS_FN Vec3<T> mean_gradient(const Camera& camera, const Projection<T>& p, const Footprint<T>& g,
                              Vec3<T> toward_x, Vec3<T> toward_y) {
  const T zero = constant<T>(0.0f);
  const T stretch_x = constant<T>(camera.fx) * p.inverse_z, stretch_y = constant<T>(camera.fy) * p.inverse_z;
  T dx = stretch_x * g.x, dy = stretch_y * g.y, dz = g.depth;
  if (!camera.orthographic) {
    const Vec3<T> forward = constant<T>(camera.forward);
    const T du = zero_unless(p.u_moves, (zero - stretch_x) * dot(toward_x, forward) * p.inverse_z);
    const T dv = zero_unless(p.v_moves, (zero - stretch_y) * dot(toward_y, forward) * p.inverse_z);
    const T shrink = dx * p.local.x + dy * p.local.y + dot(toward_x, p.toward_x) + dot(toward_y, p.toward_y);
    dz = dz - p.inverse_z * shrink - du * p.u - dv * p.v;
    dx = dx + du, dy = dy + dv;
  }
  return dx * constant<T>(camera.right) + dy * constant<T>(camera.down) + dz * constant<T>(camera.forward);
}

// Gradient of the Gaussian from that of its footprint. Lanes that are not valid hold nonsense.
template <class T>
VDGS_FN Gaussian<T> project_backward(const Camera& camera, const Gaussian<T>& gaussian, const Projection<T>& p,
                                     const Footprint<T>& g) {
  Vec3<T> dx, dy;
  conic_gradient(p, g, dx, dy);
  const Columns<T>& r = p.rotation;
  const Vec3<T> s = gaussian.scale;
  const Columns<T> d = {semi_axis_gradient(p, dx.x, dy.x), semi_axis_gradient(p, dx.y, dy.y),
                        semi_axis_gradient(p, dx.z, dy.z)};
  const Vec3<T> a = s.x * r.a, b = s.y * r.b, c = s.z * r.c;
  Gaussian<T> out;
  out.mean = mean_gradient(camera, p, g, dx.x * a + dx.y * b + dx.z * c, dy.x * a + dy.y * b + dy.z * c);
  if (camera.blur > 0.0f && !camera.orthographic)
    out.mean = out.mean + blur_gradient(p, g) * constant<T>(camera.forward);
  out.scale = {dot(d.a, r.a), dot(d.b, r.b), dot(d.c, r.c)};
  const Quaternion<T> q = p.unit;
  const Quaternion<T> dq = rotation_gradient(q, Columns<T>{s.x * d.a, s.y * d.b, s.z * d.c});
  const T along = dq.w * q.w + dq.x * q.x + dq.y * q.y + dq.z * q.z;  // changes the length alone
  const T f = p.inverse_length;
  out.quaternion = {f * (dq.w - along * q.w), f * (dq.x - along * q.x), f * (dq.y - along * q.y),
                    f * (dq.z - along * q.z)};
  return out;
}

// ---------------------------------------------------------------------------------------- anchors

// What all splats of one anchor share: exp of its six log-scales.
template <class T>
struct Anchor {
  Vec3<T> position;
  Vec3<T> extent;  // stretches the offsets
  Vec3<T> size;    // largest scales of the splats
};

// Scaffold-GS: mean x + O exp(s[0:3]), scales exp(s[3:6]) sigmoid(cov[0:3]), rotation cov[3:7].
template <class T>
VDGS_FN Gaussian<T> spawn(const Anchor<T>& anchor, Vec3<T> offset, const T* covariance) {
  return {{fma(offset.x, anchor.extent.x, anchor.position.x), fma(offset.y, anchor.extent.y, anchor.position.y),
           fma(offset.z, anchor.extent.z, anchor.position.z)},
          {anchor.size.x * sigmoid(covariance[0]), anchor.size.y * sigmoid(covariance[1]),
           anchor.size.z * sigmoid(covariance[2])},
          {covariance[3], covariance[4], covariance[5], covariance[6]}};
}

// Gradients of what `spawn` was given; log_extent and log_size are s[0:3] and s[3:6].
template <class T>
struct SpawnGradient {
  Vec3<T> offset, log_extent, log_size;
  T covariance[7];
};

template <class T>
VDGS_FN SpawnGradient<T> spawn_backward(const Anchor<T>& anchor, Vec3<T> offset, const T* covariance,
                                        const Gaussian<T>& spawned, const Gaussian<T>& g) {
  SpawnGradient<T> out;
  out.offset = {g.mean.x * anchor.extent.x, g.mean.y * anchor.extent.y, g.mean.z * anchor.extent.z};
  out.log_extent = {out.offset.x * offset.x, out.offset.y * offset.y, out.offset.z * offset.z};
  out.log_size = {g.scale.x * spawned.scale.x, g.scale.y * spawned.scale.y, g.scale.z * spawned.scale.z};
  const T one = constant<T>(1.0f);
  out.covariance[0] = out.log_size.x * (one - sigmoid(covariance[0]));
  out.covariance[1] = out.log_size.y * (one - sigmoid(covariance[1]));
  out.covariance[2] = out.log_size.z * (one - sigmoid(covariance[2]));
  out.covariance[3] = g.quaternion.w, out.covariance[4] = g.quaternion.x;
  out.covariance[5] = g.quaternion.y, out.covariance[6] = g.quaternion.z;
  return out;
}

// Whether any pixel's center lies in the box around {alpha >= 1/255}: alpha = opacity exp(-q/2) falls
// to 1/255 on the ellipse q = 2 log(255 opacity), which reaches sqrt(q variance) to either side.
template <class T>
VDGS_FN Mask<T> on_image(const Camera& camera, const Projection<T>& p, T opacity) {
  const T half = constant<T>(0.5f);
  const T level = constant<T>(2.0f) * log(opacity * constant<T>(1.0f / kAlphaMin));
  const T reach_x = sqrt(level * p.variance_x), reach_y = sqrt(level * p.variance_y);
  return le(constant<T>(kAlphaMin), opacity) & le(half, p.drawn.x + reach_x) & le(half, p.drawn.y + reach_y) &
         le(p.drawn.x - reach_x, constant<T>(camera.width) - half) &
         le(p.drawn.y - reach_y, constant<T>(camera.height) - half);
}

}  // namespace vdgs
