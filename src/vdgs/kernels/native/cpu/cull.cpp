// Which anchors a camera may see; the bound is explained in src/vdgs/kernels/torch_ref/cull.py.
#include <vector>

#include "bindings.h"
#include "gaussian.h"
#include "threads.h"

namespace vdgs {
namespace {

constexpr int64_t kPiece = 8192;

// The largest of the first three log-scales of each of sixteen anchors.
VDGS_INLINE F16 largest_log_scale(const float* log_scales) {
  alignas(64) float largest[kLanes];
  for (int lane = 0; lane < kLanes; ++lane) {
    const float* s = log_scales + 6 * lane;
    const float first_two = s[0] > s[1] ? s[0] : s[1];
    largest[lane] = first_two > s[2] ? first_two : s[2];
  }
  return load(largest);
}

VDGS_INLINE unsigned visible(const Camera& camera, const float* positions, const float* log_scales) {
  Vec3<F16> x;
  load3(positions, x.x, x.y, x.z);
  const Vec3<F16> local = into_camera(camera, x);
  if (none(gt(local.z, splat(camera.near)))) return 0;
  const Sight<F16> sight = sight_of(camera, local);
  const M16 surely = sight.surely();
  if (bits(surely) == bits(sight.before)) return bits(surely);  // most batches of a sorted model: no scales needed
  return bits(sight.holds(largest_log_scale(log_scales)));
}

// The last, incomplete sixteen: copied, so that nothing is read behind the end.
unsigned visible_rest(const Camera& camera, const float* positions, const float* log_scales, int count) {
  float p[3 * kLanes] = {}, s[6 * kLanes] = {};
  std::memcpy(p, positions, sizeof(float) * 3 * static_cast<size_t>(count));
  std::memcpy(s, log_scales, sizeof(float) * 6 * static_cast<size_t>(count));
  return visible(camera, p, s) & bits(first_lanes(count));
}

std::vector<uint16_t> visible_masks(const Camera& camera, const float* positions, const float* log_scales, int64_t n) {
  std::vector<uint16_t> masks(static_cast<size_t>((n + kLanes - 1) / kLanes));
  parallel_for((n + kPiece - 1) / kPiece, [&](int64_t piece) {
    const int64_t end = std::min(n, (piece + 1) * kPiece);
    for (int64_t i = piece * kPiece; i < end; i += kLanes) {
      const unsigned mask = end - i >= kLanes ? visible(camera, positions + 3 * i, log_scales + 6 * i)
                                              : visible_rest(camera, positions + 3 * i, log_scales + 6 * i,
                                                             static_cast<int>(end - i));
      masks[static_cast<size_t>(i / kLanes)] = static_cast<uint16_t>(mask);
    }
  });
  return masks;
}

// Sixteen bits per batch of anchors, and how many are set.
struct VisibleSet {
  std::vector<uint16_t> masks;
  int64_t count = 0;
};

VisibleSet cull(const Array<const float>& positions, const Array<const float>& log_scales,
                const Array<const float>& packed) {
  const Camera camera = unpack_camera(packed.data());
  const nb::gil_scoped_release unlocked;
  VisibleSet set{visible_masks(camera, positions.data(), log_scales.data(), static_cast<int64_t>(positions.shape(0)))};
  for (const uint16_t mask : set.masks) set.count += __builtin_popcount(mask);
  return set;
}

void write_indices(const VisibleSet& set, const Array<int64_t>& indices) {
  int64_t* out = indices.data();
  const nb::gil_scoped_release unlocked;
  for (size_t i = 0; i < set.masks.size(); ++i)
    for (unsigned left = set.masks[i]; left; left &= left - 1)
      *out++ = static_cast<int64_t>(i) * kLanes + __builtin_ctz(left);
}

}  // namespace
}  // namespace vdgs

VDGS_BIND(cull) {
  using namespace vdgs;
  nb::class_<VisibleSet>(m, "VisibleSet").def_ro("count", &VisibleSet::count).def("write", &write_indices);
  m.def("cull", &cull);
}
