// The splats of merged Gaussians in a view, sixteen at a time, straight from numbers in half precision: what they look
// like, and how much of what they stand for is drawn. The formulas are explained in
// src/vdgs/kernels/torch_ref/merged_splats.py.
#include <algorithm>
#include <cmath>

#include "bindings.h"
#include "cpu/rows.h"
#include "cpu/sh_basis.h"
#include "gaussian.h"
#include "simd/math.h"
#include "threads.h"

namespace vdgs {
namespace {

constexpr int64_t kPiece = 2048;
constexpr float kRootHalf = 0.70710678118654752f;
// Nothing is drawn beyond so many standard deviations, squared: exp(-q / 2) is less than kAlphaMin there.
constexpr float kReachSquared = 11.09f;

// Rows of Gaussians. Places are floats, everything else is `Number`s.
template <class Number>
struct MergedRows {
  const float* means;
  const Number *log_scales, *quaternions, *opacity_logits, *sh0, *sh_rest, *covers, *weight_mean, *weight_std, *cov;
  const Number* factors;  // of the opacities; null: all 1
  int64_t count;
};

struct SplatRows {
  float *means_px, *conics, *depths, *colors, *opacities;
};

// As `LOG_STDS`, `MAX_STDS` and `LEAST_WEIGHT` of torch_ref.merged_splats.
constexpr float kLeastStd = 1e-2f, kMostStd = 3.0f, kMaxStds = 6.0f, kLeastWeight = 1e-30f;

// e^(x^2) erfc(x) for x >= 0: t e^p(t) with t = 1 / (1 + x / 2). Fitted by Chebyshev's polynomials to 3e-6 of itself.
VDGS_INLINE F16 scaled_erfc(F16 x) {
  const F16 t = exact_reciprocal(fma(x, splat(0.5f), splat(1.0f)));
  F16 p = splat(-0.16612211f);
  p = fma(p, t, splat(0.66851516f));
  p = fma(p, t, splat(-0.87290415f));
  p = fma(p, t, splat(0.24829064f));
  p = fma(p, t, splat(0.00403571f));
  p = fma(p, t, splat(0.38408984f));
  p = fma(p, t, splat(0.99960458f));
  p = fma(p, t, splat(-1.2655093f));
  return t * exp(p);
}

// N(x) from |x| and e^(-x^2 / 2).
VDGS_INLINE F16 normal_distribution(F16 x, F16 density) {
  const F16 tail = splat(0.5f) * density * scaled_erfc(abs(x) * splat(kRootHalf));
  return select(lt(x, splat(0.0f)), tail, splat(1.0f) - tail);
}

VDGS_INLINE F16 bell(F16 x) { return exp(splat(-0.5f) * x * x); }

// What is drawn of the members (`torch_ref.merged_splats.shown_members`).
struct Shown {
  F16 share, larger;
};

// `least`: the logarithm of the least weight that is drawn.
VDGS_INLINE Shown shown_members(F16 mean, F16 given_std, F16 least) {
  const F16 zero = splat(0.0f);
  const F16 std = clamp(given_std, kLeastStd, kMostStd);
  const F16 below = least - mean;
  const F16 distance = max((zero - below) / std, splat(-kMaxStds));
  const F16 density = bell(distance), beyond = distance - std;
  // t e^(s^2/2 - m) N(d - s): left of the middle e^(-d^2/2) is taken out of both, one huge, one tiny.
  const F16 left = splat(0.5f) * density * scaled_erfc(max(zero - beyond, zero) * splat(kRootHalf));
  const F16 right = exp(fma(std * std, splat(0.5f), below)) * normal_distribution(beyond, bell(beyond));
  const F16 cut = select(lt(beyond, zero), left, right);
  const F16 shown = clamp(normal_distribution(distance, density) - cut, 0.0f, 1.0f);
  const F16 larger = min(cut / max(shown, splat(kLeastWeight)), splat(kMaxStds) / std);
  return {zero_unless(gt(distance, splat(-kMaxStds)), shown), larger};
}

// -log(1 - share), from 1 - share^2 as well: either is right where the other is lost to rounding. Kahan's way for small
// shares.
VDGS_INLINE F16 depth_of(F16 share, F16 rest) {
  const F16 one = splat(1.0f), zero = splat(0.0f);
  const F16 left = one - share, lost = one - left;
  const F16 small = select(gt(lost, zero), (zero - log(max(left, splat(kLeastWeight)))) * (share / lost), share);
  const F16 large = zero - log(max(rest / (one + share), splat(kLeastWeight)));
  return select(lt(share, splat(0.5f)), small, large);
}

// 1 - e^-a for a >= 0.
VDGS_INLINE F16 opacity_of(F16 a) {
  const F16 half = tanh(splat(0.5f) * a);
  return (half + half) / (splat(1.0f) + half);
}

template <int degree, class Number>
VDGS_INLINE void colors_of(const MergedRows<Number>& rows, int64_t first, const Camera& camera, const Vec3<F16>& mean,
                           F16 larger, F16 (&color)[3]) {
  constexpr int f = functions(degree);
  Vec3<F16> ray = constant<F16>(camera.forward);
  if (!camera.orthographic) {
    const Vec3<F16> eye = constant<F16>(camera.center);
    ray = {mean.x - eye.x, mean.y - eye.y, mean.z - eye.z};
    const F16 scale = exact_reciprocal(max(sqrt(dot(ray, ray)), splat(1e-12f)));
    ray = scale * ray;
  }
  F16 at[f];
  basis<degree>(ray.x, ray.y, ray.z, at);
  F16 dc[3], cov[3];
  load_columns(rows.sh0, first, rows.count, dc);
  load_columns(rows.cov, first, rows.count, cov);
  for (int c = 0; c < 3; ++c) color[c] = fma(at[0], fma(larger, cov[c], dc[c]), splat(0.5f));
  if constexpr (degree > 0) {
    F16 rest[3 * (f - 1)];
    load_columns(rows.sh_rest, first, rows.count, rest);
    for (int i = 1; i < f; ++i)
      for (int c = 0; c < 3; ++c) color[c] = fma(at[i], rest[3 * (i - 1) + c], color[c]);
  }
  for (int c = 0; c < 3; ++c) color[c] = max(color[c], splat(0.0f));
}

// Whether some of sixteen may show in a pixel: the test of `cull`, whose three standard deviations are too few here.
VDGS_INLINE bool some_in_sight(const Camera& camera, const F16 (&m)[3], const F16 (&s)[3]) {
  Sight<F16> sight = sight_of(camera, into_camera(camera, Vec3<F16>{m[0], m[1], m[2]}));
  sight.least = splat(kReachSquared / 9.0f) * sight.least;
  const float wider = 0.5f * std::log(kReachSquared / 9.0f);
  return any(sight.holds(max(max(s[0], s[1]), s[2]) + splat(wider)));
}

void clear_sixteen(int64_t first, int64_t n, const SplatRows& out) {
  const int64_t count = std::min<int64_t>(kLanes, n - first);
  const auto clear = [&](float* rows, int64_t width) { std::fill_n(rows + first * width, count * width, 0.0f); };
  clear(out.means_px, 2), clear(out.conics, 3), clear(out.depths, 1), clear(out.colors, 3), clear(out.opacities, 1);
}

template <int degree, class Number>
void draw_sixteen(const MergedRows<Number>& rows, const Camera& camera, int64_t first, const SplatRows& out) {
  const int64_t n = rows.count;
  F16 factor[1] = {splat(1.0f)};
  if (rows.factors) load_columns(rows.factors, first, n, factor);
  if (none(gt(factor[0], splat(0.0f)))) return clear_sixteen(first, n, out);
  F16 m[3], s[3], q[4], logit[1], covers[1], weight_mean[1], weight_std[1], color[3];
  load_columns(rows.means, first, n, m);
  load_columns(rows.log_scales, first, n, s);
  if (!some_in_sight(camera, m, s)) return clear_sixteen(first, n, out);
  load_columns(rows.quaternions, first, n, q);
  load_columns(rows.opacity_logits, first, n, logit);
  load_columns(rows.covers, first, n, covers);
  load_columns(rows.weight_mean, first, n, weight_mean);
  load_columns(rows.weight_std, first, n, weight_std);
  const Gaussian<F16> gaussian = {{m[0], m[1], m[2]}, {exp(s[0]), exp(s[1]), exp(s[2])}, {q[0], q[1], q[2], q[3]}};
  const Projection<F16> p = project(camera, gaussian);
  const F16 share = sqrt(clamp(dot(p.area, p.area) * p.inverse_determinant, 0.0f, 1.0f));
  const F16 pixels = camera.orthographic ? splat(1.0f) : p.local.z * p.local.z;
  const F16 least = splat(kAlphaMin * kDilationPx2 / (camera.fx * camera.fy)) * pixels;
  // Members fade as the Gaussian does that stands for them.
  const F16 faded = weight_mean[0] + log(max(factor[0], splat(kLeastWeight)));
  const Shown shown = shown_members(faded, weight_std[0], log(max(least, splat(kLeastWeight))));
  colors_of<degree>(rows, first, camera, gaussian.mean, shown.larger, color);
  const F16 rest = p.dilation * (p.variance_x + p.variance_y - p.dilation) * p.inverse_determinant;
  const F16 layers = covers[0] * depth_of(share, rest), opacity = factor[0] * sigmoid(logit[0]);
  const F16 drawn = min(opacity * opacity_of(layers), fma(opacity, opacity_of(layers * shown.share), splat(kAlphaMin)));

  const auto if_valid = [&](F16 a) { return zero_unless(p.valid, a); };
  store_columns<2>(out.means_px, first, n, {if_valid(p.drawn.x), if_valid(p.drawn.y)});
  store_columns<3>(out.conics, first, n,
                   {if_valid(p.drawn.conic_xx), if_valid(p.drawn.conic_xy), if_valid(p.drawn.conic_yy)});
  store_columns<1>(out.depths, first, n, {if_valid(p.drawn.depth)});
  store_columns<3>(out.colors, first, n, {color[0], color[1], color[2]});
  store_columns<1>(out.opacities, first, n, {zero_unless(p.valid & gt(shown.share, splat(0.0f)), drawn)});
}

template <class Number>
void draw(const MergedRows<Number>& rows, const Array<const float>& packed, int degree, const SplatRows& out) {
  const Camera camera = unpack_camera(packed.data());
  const nb::gil_scoped_release unlocked;
  with_degree(degree, [&](auto of) {
    parallel_for((rows.count + kPiece - 1) / kPiece, [&](int64_t piece) {
      const int64_t end = std::min(rows.count, (piece + 1) * kPiece);
      for (int64_t first = piece * kPiece; first < end; first += kLanes)
        draw_sixteen<decltype(of)::value>(rows, camera, first, out);
    });
  });
}

using Floats = Array<const float>;
using Halves = Array<const uint16_t>;
using Out = Array<float>;

template <class Numbers, class Number>
void bound(const Floats& means, const Numbers& log_scales, const Numbers& quaternions, const Numbers& opacity_logits,
           const Numbers& sh0, const Numbers& sh_rest, const Numbers& covers, const Numbers& weight_mean,
           const Numbers& weight_std, const Numbers& cov, const Numbers& factors,
           const Floats& camera, int degree, const Out& means_px, const Out& conics,
           const Out& depths, const Out& colors, const Out& opacities) {
  const auto of = [](const Numbers& array) { return reinterpret_cast<const Number*>(array.data()); };
  const MergedRows<Number> rows = {means.data(), of(log_scales), of(quaternions), of(opacity_logits), of(sh0),
                                   of(sh_rest), of(covers), of(weight_mean), of(weight_std), of(cov),
                                   factors.shape(0) ? of(factors) : nullptr,
                                   static_cast<int64_t>(means.shape(0))};
  draw(rows, camera, degree,
       {means_px.data(), conics.data(), depths.data(), colors.data(), opacities.data()});
}

}  // namespace
}  // namespace vdgs

VDGS_BIND(merged) {
  m.def("merged_splats", &vdgs::bound<vdgs::Floats, float>);
  m.def("merged_splats_of_halves", &vdgs::bound<vdgs::Halves, vdgs::Half>);
}
