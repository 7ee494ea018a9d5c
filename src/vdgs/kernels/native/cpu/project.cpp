// Projection of free Gaussians (not spawned by anchors), sixteen at a time.
#include "bindings.h"
#include "cpu/rows.h"
#include "gaussian.h"
#include "threads.h"

namespace vdgs {
namespace {

constexpr int64_t kPiece = 4096;

using Rows = Array<const float>;
using Out = Array<float>;

struct GaussianRows {
  const float *means, *scales, *quaternions;
  int64_t count;
};

VDGS_INLINE Gaussian<F16> load_gaussians(const GaussianRows& rows, int64_t first) {
  F16 m[3], s[3], q[4];
  load_columns(rows.means, first, rows.count, m);
  load_columns(rows.scales, first, rows.count, s);
  load_columns(rows.quaternions, first, rows.count, q);
  return {{m[0], m[1], m[2]}, {s[0], s[1], s[2]}, {q[0], q[1], q[2], q[3]}};
}

template <class Body>
void for_each_sixteen(int64_t n, const Body& body) {
  parallel_for((n + kPiece - 1) / kPiece, [&](int64_t piece) {
    const int64_t end = std::min(n, (piece + 1) * kPiece);
    for (int64_t first = piece * kPiece; first < end; first += kLanes) body(first);
  });
}

void forward(const Rows& means, const Rows& scales, const Rows& quaternions, const Rows& packed, const Out& means_px,
             const Out& conics, const Out& depths, const Array<uint8_t>& valid) {
  const Camera camera = unpack_camera(packed.data());
  const GaussianRows rows = {means.data(), scales.data(), quaternions.data(), static_cast<int64_t>(means.shape(0))};
  float *xy = means_px.data(), *k = conics.data(), *z = depths.data();
  uint8_t* is_valid = valid.data();
  const nb::gil_scoped_release unlocked;
  for_each_sixteen(rows.count, [&](int64_t first) {
    const Projection<F16> p = project(camera, load_gaussians(rows, first));
    const auto shown = [&](F16 a) { return zero_unless(p.valid, a); };
    store_columns<2>(xy, first, rows.count, {shown(p.drawn.x), shown(p.drawn.y)});
    store_columns<3>(k, first, rows.count, {shown(p.drawn.conic_xx), shown(p.drawn.conic_xy), shown(p.drawn.conic_yy)});
    store_columns<1>(z, first, rows.count, {shown(p.drawn.depth)});
    const int64_t count = std::min<int64_t>(kLanes, rows.count - first);
    for (int64_t lane = 0; lane < count; ++lane) is_valid[first + lane] = (bits(p.valid) >> lane) & 1u;
  });
}

void backward(const Rows& means, const Rows& scales, const Rows& quaternions, const Rows& packed, const Rows& d_means_px,
              const Rows& d_conics, const Rows& d_depths, const Out& d_means, const Out& d_scales,
              const Out& d_quaternions) {
  const Camera camera = unpack_camera(packed.data());
  const GaussianRows rows = {means.data(), scales.data(), quaternions.data(), static_cast<int64_t>(means.shape(0))};
  const float *g_xy = d_means_px.data(), *g_k = d_conics.data(), *g_z = d_depths.data();
  float *out_means = d_means.data(), *out_scales = d_scales.data(), *out_quaternions = d_quaternions.data();
  const nb::gil_scoped_release unlocked;
  for_each_sixteen(rows.count, [&](int64_t first) {
    const Gaussian<F16> gaussian = load_gaussians(rows, first);
    const Projection<F16> p = project(camera, gaussian);
    F16 xy[2], k[3], z[1];
    load_columns(g_xy, first, rows.count, xy);
    load_columns(g_k, first, rows.count, k);
    load_columns(g_z, first, rows.count, z);
    const Gaussian<F16> g =
        project_backward(camera, gaussian, p, Footprint<F16>{xy[0], xy[1], z[0], k[0], k[1], k[2]});
    const auto shown = [&](F16 a) { return zero_unless(p.valid, a); };
    store_columns<3>(out_means, first, rows.count, {shown(g.mean.x), shown(g.mean.y), shown(g.mean.z)});
    store_columns<3>(out_scales, first, rows.count, {shown(g.scale.x), shown(g.scale.y), shown(g.scale.z)});
    store_columns<4>(out_quaternions, first, rows.count,
                     {shown(g.quaternion.w), shown(g.quaternion.x), shown(g.quaternion.y), shown(g.quaternion.z)});
  });
}

}  // namespace
}  // namespace vdgs

VDGS_BIND(project) {
  using namespace vdgs;
  m.def("project", &forward);
  m.def("project_backward", &backward);
  nb::dict constants;
  constants["ALPHA_MIN"] = kAlphaMin;
  constants["ALPHA_MAX"] = kAlphaMax;
  constants["TRANSMITTANCE_MIN"] = kTransmittanceMin;
  constants["DILATION_PX2"] = kDilationPx2;
  constants["FRUSTUM_MARGIN"] = kFrustumMargin;
  m.attr("constants") = constants;
}
