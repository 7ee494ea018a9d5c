// Anchors to splats in one step: vdgs.kernels.reference.decode on a GPU, without autograd.
//
// A warp an anchor: 32 lanes are the 32 units of a hidden layer, and then up to 32 offsets. What an anchor is made of is
// read once, and only splats are written: hidden layers, opacities, covariances and Gaussians never leave the registers.
// Opacity comes first; the other heads are asked only where an offset is opaque. Projection and spawning are
// gaussian_math.h, which the processor uses too.
//
// It runs twice: first to count the splats of each anchor, then, once there is room for them, to write them behind those
// of the anchors before. Results are the same bits every time.
#include "gaussian_math.h"

namespace {

using vdgs::Vec3;

constexpr int kWarp = 32;
constexpr int kWarps = 8;
constexpr int kThreads = kWarp * kWarps;
constexpr unsigned kAllLanes = 0xffffffffu;
constexpr int kFeatures = 32;
constexpr int kHidden = kWarp;

// One MLP. Weights lie so that neighbouring lanes read neighbouring numbers: w1 [inputs, 32], w2 [32, outputs].
struct Head {
  const float* w1;
  const float* b1;
  const float* w2;
  const float* b2;
};

// What a head sees: a feature each lane, and what all of them know.
struct Inputs {
  float feature;
  Vec3<float> direction;
  float distance;
};

// The lane's unit of the hidden layer.
__device__ float hidden_of(const Head& head, const Inputs& inputs, bool with_distance) {
  const int lane = threadIdx.x % kWarp;
  float sum = head.b1[lane];
  for (int i = 0; i < kFeatures; ++i) {
    sum = fmaf(head.w1[i * kHidden + lane], __shfl_sync(kAllLanes, inputs.feature, i), sum);
  }
  const float* rest = head.w1 + kFeatures * kHidden + lane;
  sum = fmaf(rest[0], inputs.direction.x, sum);
  sum = fmaf(rest[kHidden], inputs.direction.y, sum);
  sum = fmaf(rest[2 * kHidden], inputs.direction.z, sum);
  if (with_distance) sum = fmaf(rest[3 * kHidden], inputs.distance, sum);
  return fmaxf(sum, 0.0f);
}

// Outputs `first` ... of a head, which differ from lane to lane; lanes that want none still lend their unit.
template <int count>
__device__ void outputs_of(const Head& head, float hidden, int outputs, int first, bool wanted, float (&out)[count]) {
  for (int c = 0; c < count; ++c) out[c] = wanted ? head.b2[first + c] : 0.0f;
  for (int j = 0; j < kHidden; ++j) {
    const float unit = __shfl_sync(kAllLanes, hidden, j);
    for (int c = 0; c < count; ++c) {
      if (wanted) out[c] = fmaf(head.w2[j * outputs + first + c], unit, out[c]);
    }
  }
}

__device__ bool is_finite(float a) { return fabsf(a) <= 3.402823466e38f; }
__device__ bool is_finite(Vec3<float> a) { return is_finite(a.x) && is_finite(a.y) && is_finite(a.z); }

__device__ Vec3<float> read(const float* at) { return {at[0], at[1], at[2]}; }
__device__ Vec3<float> exp_of(Vec3<float> a) { return {expf(a.x), expf(a.y), expf(a.z)}; }

}  // namespace

// A warp an anchor of `rows` [v] (null: all). `ends` [v]: where the splats of each anchor end; null: they are counted
// instead, into `counts` [v], and nothing else is written.
extern "C" __global__ void __launch_bounds__(kThreads)
decode_anchors(const float* positions, const float* features, const float* offsets, const float* log_scales,
               const float* o_w1, const float* o_b1, const float* o_w2, const float* o_b2, const float* c_w1,
               const float* c_b1, const float* c_w2, const float* c_b2, const float* r_w1, const float* r_b1,
               const float* r_w2, const float* r_b2, vdgs::Camera camera, const long long* rows, long long count,
               int k, int with_distance, const long long* ends, long long* counts, float* means_px, float* conics,
               float* depths, float* colours, float* opacities, float* volumes, int* source) {
  const long long visible = static_cast<long long>(blockIdx.x) * kWarps + threadIdx.x / kWarp;
  if (visible >= count) return;  // whole warps
  const int lane = threadIdx.x % kWarp;
  const long long row = rows ? rows[visible] : visible;

  Inputs inputs{features[row * kFeatures + lane], {}, 0.0f};
  const Vec3<float> position = read(positions + 3 * row);
  const Vec3<float> ray = {position.x - camera.centre.x, position.y - camera.centre.y, position.z - camera.centre.z};
  inputs.distance = sqrtf(vdgs::dot(ray, ray));
  inputs.direction = camera.orthographic ? camera.forward : (1.0f / inputs.distance) * ray;
  const vdgs::Anchor<float> anchor{position, exp_of(read(log_scales + 6 * row)), exp_of(read(log_scales + 6 * row + 3))};
  const bool sound = is_finite(position) && is_finite(inputs.direction) && is_finite(inputs.distance) &&
                     is_finite(anchor.extent) && is_finite(anchor.size);
  const bool whole = !__any_sync(kAllLanes, !(sound && is_finite(inputs.feature)));

  const Head opacity_head{o_w1, o_b1, o_w2, o_b2};
  float opacity[1];
  outputs_of(opacity_head, hidden_of(opacity_head, inputs, with_distance), k, lane, lane < k, opacity);
  opacity[0] = tanhf(opacity[0]);
  const float* offset_at = offsets + (row * k + (lane < k ? lane : 0)) * 3;
  const Vec3<float> offset = read(offset_at);
  const bool opaque = whole && lane < k && opacity[0] > 0.0f && is_finite(offset);
  if (!__any_sync(kAllLanes, opaque)) {
    if (!ends && lane == 0) counts[visible] = 0;
    return;
  }

  const Head covariance_head{c_w1, c_b1, c_w2, c_b2};
  float covariance[7];
  outputs_of(covariance_head, hidden_of(covariance_head, inputs, with_distance), 7 * k, 7 * lane, lane < k, covariance);
  const vdgs::Gaussian<float> gaussian = vdgs::spawn(anchor, offset, covariance);
  const vdgs::Projection<float> p = vdgs::project(camera, gaussian);
  const bool kept = opaque && p.valid && vdgs::on_image(camera, p, opacity[0]);
  const unsigned all_kept = __ballot_sync(kAllLanes, kept);
  if (!ends) {
    if (lane == 0) counts[visible] = __popc(all_kept);
    return;
  }
  if (!all_kept) return;

  const Head colour_head{r_w1, r_b1, r_w2, r_b2};
  float colour[3];
  outputs_of(colour_head, hidden_of(colour_head, inputs, with_distance), 3 * k, 3 * lane, lane < k, colour);
  if (!kept) return;
  const long long before = visible ? ends[visible - 1] : 0;
  const long long at = before + __popc(all_kept & ((1u << lane) - 1u));
  means_px[2 * at] = p.drawn.x, means_px[2 * at + 1] = p.drawn.y;
  conics[3 * at] = p.drawn.conic_xx, conics[3 * at + 1] = p.drawn.conic_xy, conics[3 * at + 2] = p.drawn.conic_yy;
  depths[at] = p.drawn.depth;
  for (int c = 0; c < 3; ++c) colours[3 * at + c] = vdgs::sigmoid(colour[c]);
  opacities[at] = opacity[0];
  volumes[at] = gaussian.scale.x * gaussian.scale.y * gaussian.scale.z;
  source[at] = static_cast<int>(visible * k + lane);
}
