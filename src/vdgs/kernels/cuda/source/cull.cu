// Which anchors a camera may see: vdgs.kernels.torch_ref.cull on a GPU.
//
// A thread an anchor, twice: first a bit for each, 32 of them a word, and how many of a word are set; once these are added
// up and there is room, the anchor of each set bit goes to its place, so that indices ascend. Scales are read only of
// anchors whose center does not already lie on the image. The bound is gaussian_math.h, which the processor uses too.
#include "gaussian_math.h"

namespace {

using vdgs::Vec3;

constexpr int kWarp = 32;
constexpr int kThreads = 256;
constexpr unsigned kAllLanes = 0xffffffffu;

// The anchor of the thread, or one behind the last.
__device__ long long anchor_of_thread() { return static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x; }

__device__ bool may_show(const vdgs::Camera& camera, const float* position, const float* log_scale) {
  const Vec3<float> local = vdgs::into_camera(camera, Vec3<float>{position[0], position[1], position[2]});
  const vdgs::Sight<float> sight = vdgs::sight_of(camera, local);
  if (!sight.before) return false;
  return sight.surely() || sight.holds(vdgs::max(vdgs::max(log_scale[0], log_scale[1]), log_scale[2]));
}

}  // namespace

// `marks` and `found` [n / 32]: the bits of 32 anchors, and how many of them are set.
extern "C" __global__ void __launch_bounds__(kThreads)
mark_anchors(const float* positions, const float* log_scales, vdgs::Camera camera, long long count, unsigned* marks,
             int* found) {
  const long long anchor = anchor_of_thread();
  const bool kept = anchor < count && may_show(camera, positions + 3 * anchor, log_scales + 6 * anchor);
  const unsigned mark = __ballot_sync(kAllLanes, kept);
  if (anchor >= count || anchor % kWarp) return;
  marks[anchor / kWarp] = mark;
  found[anchor / kWarp] = __popc(mark);
}

// `ends` [n / 32]: where the anchors of each word end among `rows`.
extern "C" __global__ void __launch_bounds__(kThreads)
write_rows(const unsigned* marks, const int* ends, long long count, long long* rows) {
  const long long anchor = anchor_of_thread();
  if (anchor >= count) return;
  const unsigned mark = marks[anchor / kWarp], from_here = mark >> anchor % kWarp;
  if (from_here & 1u) rows[ends[anchor / kWarp] - __popc(from_here)] = anchor;
}
