// Anchors to splats in one step: vdgs.kernels.torch_ref.decode on a GPU, without autograd.
//
// A warp an anchor: 32 lanes are the 32 units of a hidden layer, and then up to 32 offsets. Only splats are written: hidden
// layers, opacities, covariances and Gaussians never leave the registers. Opacity comes first; the other heads are asked
// only where an offset is opaque. Projection and spawning are gaussian_math.h, which the processor uses too.
//
// One pass: a block adds up how many splats its anchors show, takes room for them by one addition to a counter that all
// blocks share, and writes them there. No block waits for another. The splats of a block lie together and in order; which
// block comes first is left to the card, and `begins` and `lengths` tell.
#include "gaussian_math.h"

namespace {

using vdgs::Vec3;

constexpr int kWarp = 32;
constexpr int kWarps = 8;
constexpr int kThreads = kWarp * kWarps;
constexpr unsigned kAllLanes = 0xffffffffu;
constexpr int kFeatures = 32;
constexpr int kHidden = kWarp;

// One MLP, c outputs an offset. Weights lie so that neighboring lanes read neighboring numbers: w1 [inputs, 32], w2
// [32, c, k], b2 [c, k].
struct Head {
  const float *w1, *b1, *w2, *b2;
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

// Outputs of a head for the offset of each lane; lanes that want none still lend their unit.
template <int count>
__device__ void outputs_of(const Head& head, float hidden, int k, bool wanted, float (&out)[count]) {
  const int lane = threadIdx.x % kWarp;
  for (int c = 0; c < count; ++c) out[c] = wanted ? head.b2[c * k + lane] : 0.0f;
  const float* weight = head.w2 + lane;
#pragma unroll 4  // more of them at once, and some architectures spill
  for (int j = 0; j < kHidden; ++j) {
    const float unit = __shfl_sync(kAllLanes, hidden, j);
    for (int c = 0; c < count; ++c, weight += k)
      if (wanted) out[c] = fmaf(*weight, unit, out[c]);
  }
}

__device__ bool is_finite(float a) { return fabsf(a) <= 3.402823466e38f; }
__device__ bool is_finite(Vec3<float> a) { return is_finite(a.x) && is_finite(a.y) && is_finite(a.z); }

__device__ Vec3<float> read(const float* at) { return {at[0], at[1], at[2]}; }
__device__ Vec3<float> exp_of(Vec3<float> a) { return {expf(a.x), expf(a.y), expf(a.z)}; }

__device__ float add_over_lanes(float value) {
  for (int lanes = kWarp / 2; lanes > 0; lanes /= 2) value += __shfl_xor_sync(kAllLanes, value, lanes);
  return value;
}

// Where the splats of a visible anchor begin, from where those of its block do and what the anchors before it show.
__device__ int first_splat(const unsigned* shown, const int* begins, long long visible) {
  int first = begins[visible / kWarps];
  for (long long before = visible / kWarps * kWarps; before < visible; ++before) first += __popc(shown[before]);
  return first;
}

// How many of the set bits stand for lanes before this one.
__device__ int lanes_before(unsigned bits) { return __popc(bits & ((1u << threadIdx.x % kWarp) - 1u)); }

struct Anchors {
  const float *positions, *features, *offsets, *log_scales;
};

struct Decoder {
  Head opacity, covariance, color;
  bool with_distance;
};

// What the lane's offset looks like, if it shows.
struct Look {
  vdgs::Footprint<float> drawn;
  float color[3];
  float opacity, volume;
};

// Which offsets of an anchor show, a bit each. All lanes of a warp call it.
__device__ unsigned look_at(const Anchors& anchors, const Decoder& decoder, const vdgs::Camera& camera, long long row,
                            int k, Look& look) {
  const int lane = threadIdx.x % kWarp;
  Inputs inputs{anchors.features[row * kFeatures + lane], {}, 0.0f};
  const Vec3<float> position = read(anchors.positions + 3 * row);
  const Vec3<float> ray = {position.x - camera.center.x, position.y - camera.center.y, position.z - camera.center.z};
  inputs.distance = sqrtf(vdgs::dot(ray, ray));
  inputs.direction = camera.orthographic ? camera.forward : (1.0f / inputs.distance) * ray;
  const float* log_scales = anchors.log_scales + 6 * row;
  const vdgs::Anchor<float> anchor{position, exp_of(read(log_scales)), exp_of(read(log_scales + 3))};
  const bool sound = is_finite(position) && is_finite(inputs.direction) && is_finite(inputs.distance) &&
                     is_finite(anchor.extent) && is_finite(anchor.size);
  const bool whole = !__any_sync(kAllLanes, !(sound && is_finite(inputs.feature)));

  float opacity[1];
  outputs_of(decoder.opacity, hidden_of(decoder.opacity, inputs, decoder.with_distance), k, lane < k, opacity);
  look.opacity = tanhf(opacity[0]);
  const bool opaque = whole && lane < k && look.opacity > 0.0f;
  if (!__any_sync(kAllLanes, opaque)) return 0u;

  const Vec3<float> offset = opaque ? read(anchors.offsets + (row * k + lane) * 3) : Vec3<float>{};
  float covariance[7];
  outputs_of(decoder.covariance, hidden_of(decoder.covariance, inputs, decoder.with_distance), k, opaque, covariance);
  const vdgs::Gaussian<float> gaussian = vdgs::spawn(anchor, offset, covariance);
  const vdgs::Projection<float> p = vdgs::project(camera, gaussian);
  const bool kept = opaque && is_finite(offset) && p.valid && vdgs::on_image(camera, p, look.opacity);
  const unsigned all_kept = __ballot_sync(kAllLanes, kept);
  if (!all_kept) return 0u;
  look.drawn = p.drawn;
  look.volume = kept ? gaussian.scale.x * gaussian.scale.y * gaussian.scale.z : 0.0f;
  outputs_of(decoder.color, hidden_of(decoder.color, inputs, decoder.with_distance), k, kept, look.color);
  return all_kept;
}

}  // namespace

// A warp an anchor of `rows` [v] (null: all); a block has kWarps of them. `total` [1]: how many splats there are; those
// from place `capacity` on are counted, but not written. `shown` [v]: which offsets of each anchor show, a bit each. Of
// each block [v / kWarps]: where its splats begin, how many they are, and (unless null) the sum of their volumes. Of each
// splat, unless null: its volume, and its source: (place in `rows`) k + offset.
extern "C" __global__ void __launch_bounds__(kThreads, 4)
decode_anchors(const float* positions, const float* features, const float* offsets, const float* log_scales,
               const float* o_w1, const float* o_b1, const float* o_w2, const float* o_b2, const float* c_w1,
               const float* c_b1, const float* c_w2, const float* c_b2, const float* r_w1, const float* r_b1,
               const float* r_w2, const float* r_b2, vdgs::Camera camera, const long long* rows, long long count,
               int k, int with_distance, int capacity, int* total, unsigned* shown, int* begins, int* lengths,
               float* volume_sums, float* means_px, float* conics, float* depths, float* colors, float* opacities,
               float* volumes, int* source) {
  __shared__ int numbers[kWarps];
  __shared__ float sums[kWarps];
  __shared__ int first;
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  const long long visible = static_cast<long long>(blockIdx.x) * kWarps + warp;
  const Decoder decoder{{o_w1, o_b1, o_w2, o_b2}, {c_w1, c_b1, c_w2, c_b2}, {r_w1, r_b1, r_w2, r_b2},
                        with_distance != 0};
  // Warps behind the last anchor look at it too, and show nothing: all threads must come to the barriers.
  const bool there = visible < count;
  const long long at_most = there ? visible : count - 1, row = rows ? rows[at_most] : at_most;
  Look look{};
  const unsigned kept = look_at({positions, features, offsets, log_scales}, decoder, camera, row, there ? k : 0, look);
  if (there && lane == 0) shown[visible] = kept;
  const float sum = volume_sums ? add_over_lanes(look.volume) : 0.0f;
  if (lane == 0) numbers[warp] = __popc(kept), sums[warp] = sum;
  __syncthreads();  // all have counted
  if (threadIdx.x == 0) {
    int number = 0;
    float volume = 0.0f;
    for (int w = 0; w < kWarps; ++w) number += numbers[w], volume += sums[w];
    first = number > 0 ? atomicAdd(total, number) : 0;
    begins[blockIdx.x] = first, lengths[blockIdx.x] = number;
    if (volume_sums) volume_sums[blockIdx.x] = volume;
  }
  __syncthreads();  // there is room
  if (!(kept >> lane & 1u)) return;
  int place = first + lanes_before(kept);
  for (int w = 0; w < warp; ++w) place += numbers[w];
  if (place >= capacity) return;
  const long long at = place;
  means_px[2 * at] = look.drawn.x, means_px[2 * at + 1] = look.drawn.y;
  conics[3 * at] = look.drawn.conic_xx, conics[3 * at + 1] = look.drawn.conic_xy, conics[3 * at + 2] = look.drawn.conic_yy;
  depths[at] = look.drawn.depth;
  for (int c = 0; c < 3; ++c) colors[3 * at + c] = vdgs::sigmoid(look.color[c]);
  opacities[at] = look.opacity;
  if (volumes) volumes[at] = look.volume;
  if (source) source[at] = static_cast<int>(visible * k + lane);
}

// A warp an anchor: the source of each of its splats. `shown`, `begins`: as `decode_anchors` has made them.
extern "C" __global__ void __launch_bounds__(kThreads)
name_splats(const unsigned* shown, const int* begins, long long count, int k, int* source) {
  const long long visible = static_cast<long long>(blockIdx.x) * kWarps + threadIdx.x / kWarp;
  if (visible >= count) return;
  const unsigned kept = shown[visible];
  const int lane = threadIdx.x % kWarp;
  if (!(kept >> lane & 1u)) return;
  source[first_splat(shown, begins, visible) + lanes_before(kept)] = static_cast<int>(visible * k + lane);
}

namespace {

// Of the lane's unit of a hidden layer, from those of the outputs of all offsets. w2 [outputs, 32].
template <int count>
__device__ float by_hidden_of(const float* w2, int k, float hidden, const float (&by_outputs)[count]) {
  const int lane = threadIdx.x % kWarp;
  float sum = 0.0f;
  for (int offset = 0; offset < k; ++offset)
    for (int c = 0; c < count; ++c) {
      sum = fmaf(w2[(offset * count + c) * kHidden + lane], __shfl_sync(kAllLanes, by_outputs[c], offset), sum);
    }
  return hidden > 0.0f ? sum : 0.0f;
}

// Of the lane's feature, from those of the hidden layer. w1 [32, inputs].
__device__ float by_feature_of(const float* w1, int inputs, float by_hidden) {
  float sum = 0.0f;
#pragma unroll 8  // all at once take registers that twice as many warps need
  for (int j = 0; j < kHidden; ++j) {
    sum = fmaf(w1[j * inputs + threadIdx.x % kWarp], __shfl_sync(kAllLanes, by_hidden, j), sum);
  }
  return sum;
}

// A parameter of the anchors on its way to the next step of Adam.
struct Moved {
  float* parameter;
  float* first;
  float* second;
  float rate, root;  // that of this anchor, with both corrections of the bias

  // `value`: what it is now.
  __device__ void step(long long at, float value, float gradient) const {
    const float m = fmaf(0.9f, first[at], 0.1f * gradient), v = fmaf(0.999f, second[at], 0.001f * gradient * gradient);
    first[at] = m;
    second[at] = v;
    parameter[at] = value - rate * m / fmaf(sqrtf(v), root, 1e-15f);
  }
};

}  // namespace

// A warp an anchor of `rows` [v], from the place `first` on as many as `count`: what it looked like once more, the gradients
// of its splats back to it, and its step of Adam. `first` is a multiple of kWarps; `shown` and `begins` say which offsets show
// and where their splats are, as in `decode_anchors`. What these looked like is computed again, to the same bits. `updates`
// [n] counts up; `lacking` and `roots` [t] hold 1 - beta1^u and 1 / sqrt(1 - beta2^u) of u = 1, 2, ... updates. `broken` [1]
// becomes 1 where a gradient is no number: that anchor stays. `by_depths` is null where no loss reads depths.
// For the gradients of the decoder, by matrix products, with c for `count`: by the outputs of all heads [c, k + 7k + 3k],
// hidden layers and by hidden layers [c, 3, 32], inputs [c, inputs]; all of these null where nobody wants them.
extern "C" __global__ void __launch_bounds__(kThreads, 2)
move_anchors(const float* positions, float* features, float* offsets, float* log_scales, float* features_first,
             float* offsets_first, float* log_scales_first, float* features_second, float* offsets_second,
             float* log_scales_second, float features_rate, float offsets_rate, float log_scales_rate, float early,
             const float* o_w1t, const float* o_b1, const float* o_w2t, const float* o_b2, const float* c_w1t,
             const float* c_b1, const float* c_w2t, const float* c_b2, const float* r_w1t, const float* r_b1,
             const float* r_w2t, const float* r_b2, const float* o_w1, const float* o_w2, const float* c_w1,
             const float* c_w2, const float* r_w1, const float* r_w2, vdgs::Camera camera, const long long* rows,
             long long first, long long count, int k, int inputs_wide, const unsigned* shown, const int* begins,
             const float* by_means_px, const float* by_conics, const float* by_colors, const float* by_opacities,
             const float* by_depths, float by_volume, int* updates, const float* lacking, const float* roots, int most_updates, int* broken,
             float* by_outputs_out, float* hidden_out, float* by_hidden_out, float* inputs_out) {
  const long long place = static_cast<long long>(blockIdx.x) * kWarps + threadIdx.x / kWarp, visible = first + place;
  if (place >= count) return;  // whole warps
  const int lane = threadIdx.x % kWarp;
  const long long row = rows[visible];
  const unsigned kept = shown[visible];
  const bool with_distance = inputs_wide == kFeatures + 4, has_offset = lane < k;

  // All that moves, read once: it is needed here, and where it moves.
  Inputs inputs{features[row * kFeatures + lane], {}, 0.0f};
  const long long offset_at = (row * k + lane) * 3;
  const Vec3<float> offset = has_offset ? read(offsets + offset_at) : Vec3<float>{};
  const Vec3<float> log_extent = read(log_scales + 6 * row), log_size = read(log_scales + 6 * row + 3);
  vdgs::Anchor<float> anchor{{}, exp_of(log_extent), exp_of(log_size)};
  if (kept) {
    anchor.position = read(positions + 3 * row);
    const Vec3<float> x = anchor.position, c = camera.center, ray = {x.x - c.x, x.y - c.y, x.z - c.z};
    inputs.distance = sqrtf(vdgs::dot(ray, ray));
    inputs.direction = camera.orthographic ? camera.forward : (1.0f / inputs.distance) * ray;
  }

  float by_opacity[1] = {}, by_covariance[7] = {}, by_color[3] = {}, by_scales[6] = {};
  Vec3<float> by_offset{};
  float hidden[3] = {}, by_hidden[3] = {}, by_feature = 0.0f;
  if (kept) {
    const Head opacity_head{o_w1t, o_b1, o_w2t, o_b2}, covariance_head{c_w1t, c_b1, c_w2t, c_b2};
    const Head color_head{r_w1t, r_b1, r_w2t, r_b2};
    const bool shows = kept >> lane & 1u;
    const long long splat = first_splat(shown, begins, visible) + lanes_before(kept);  // that of the lane, if it shows
    hidden[0] = hidden_of(opacity_head, inputs, with_distance);
    hidden[1] = hidden_of(covariance_head, inputs, with_distance);
    hidden[2] = hidden_of(color_head, inputs, with_distance);
    float opacity[1], color[3], covariance[7];
    outputs_of(opacity_head, hidden[0], k, shows, opacity);
    if (shows) {
      const float value = tanhf(opacity[0]);
      by_opacity[0] = by_opacities[splat] * (1.0f - value * value);
    }
    outputs_of(color_head, hidden[2], k, shows, color);
    for (int c = 0; shows && c < 3; ++c) {
      const float value = vdgs::sigmoid(color[c]);
      by_color[c] = by_colors[3 * splat + c] * value * (1.0f - value);
    }
    outputs_of(covariance_head, hidden[1], k, shows, covariance);
    if (shows) {
      const vdgs::Gaussian<float> gaussian = vdgs::spawn(anchor, offset, covariance);
      const vdgs::Projection<float> p = vdgs::project(camera, gaussian);
      const float *by_px = by_means_px + 2 * splat, *by_conic = by_conics + 3 * splat;
      const float by_depth = by_depths ? by_depths[splat] : 0.0f;
      const vdgs::Footprint<float> by_drawn{by_px[0], by_px[1], by_depth, by_conic[0], by_conic[1], by_conic[2]};
      vdgs::Gaussian<float> by_gaussian = vdgs::project_backward(camera, gaussian, p, by_drawn);
      const Vec3<float> s = gaussian.scale;
      by_gaussian.scale = by_gaussian.scale + by_volume * Vec3<float>{s.y * s.z, s.x * s.z, s.x * s.y};
      const vdgs::SpawnGradient<float> g = vdgs::spawn_backward(anchor, offset, covariance, gaussian, by_gaussian);
      by_offset = g.offset;
      const Vec3<float> e = g.log_extent, z = g.log_size;
      by_scales[0] = e.x, by_scales[1] = e.y, by_scales[2] = e.z, by_scales[3] = z.x, by_scales[4] = z.y, by_scales[5] = z.z;
      for (int c = 0; c < 7; ++c) by_covariance[c] = g.covariance[c];
    }
    by_hidden[0] = by_hidden_of(o_w2, k, hidden[0], by_opacity);
    by_hidden[1] = by_hidden_of(c_w2, k, hidden[1], by_covariance);
    by_hidden[2] = by_hidden_of(r_w2, k, hidden[2], by_color);
    by_feature = by_feature_of(o_w1, inputs_wide, by_hidden[0]) + by_feature_of(c_w1, inputs_wide, by_hidden[1]) +
                 by_feature_of(r_w1, inputs_wide, by_hidden[2]);
    for (float& each : by_scales) each = add_over_lanes(each);
  }
  if (by_outputs_out) {
    if (has_offset) {
      float* out = by_outputs_out + place * 11 * k;
      out[lane] = by_opacity[0];
      for (int c = 0; c < 7; ++c) out[k + 7 * lane + c] = by_covariance[c];
      for (int c = 0; c < 3; ++c) out[8 * k + 3 * lane + c] = by_color[c];
    }
    for (int head = 0; head < 3; ++head) {
      hidden_out[(place * 3 + head) * kHidden + lane] = hidden[head];
      by_hidden_out[(place * 3 + head) * kHidden + lane] = by_hidden[head];
    }
    // An anchor that shows nothing may be made of anything: zeros for it, which times zero are zero.
    float* out = inputs_out + place * inputs_wide;
    out[lane] = kept ? inputs.feature : 0.0f;
    const float rest[4] = {inputs.direction.x, inputs.direction.y, inputs.direction.z, inputs.distance};
    if (lane < inputs_wide - kFeatures) out[kFeatures + lane] = kept ? rest[lane] : 0.0f;
  }

  bool sound = is_finite(by_feature) && is_finite(by_offset);
  for (float each : by_scales) sound = sound && is_finite(each);
  const bool stays = __any_sync(kAllLanes, !sound);  // and what follows overwrites what the lanes have read
  const int made = updates[row], nth = made < most_updates ? made : most_updates - 1;
  __syncwarp();
  if (lane == 0) updates[row] = made + 1;
  if (stays && lane == 0) *broken = 1;
  if (stays) return;
  const float root = roots[nth], faster = (root < early ? root : early) / lacking[nth];
  const Moved feature{features, features_first, features_second, features_rate * faster, root};
  feature.step(row * kFeatures + lane, inputs.feature, by_feature);
  if (has_offset) {
    const Moved moved{offsets, offsets_first, offsets_second, offsets_rate * faster, root};
    moved.step(offset_at, offset.x, by_offset.x), moved.step(offset_at + 1, offset.y, by_offset.y);
    moved.step(offset_at + 2, offset.z, by_offset.z);
  }
  const Moved scale{log_scales, log_scales_first, log_scales_second, log_scales_rate * faster, root};
  const float log_scale[6] = {log_extent.x, log_extent.y, log_extent.z, log_size.x, log_size.y, log_size.z};
#pragma unroll
  for (int i = 0; i < 6; ++i)
    if (lane == i) scale.step(6 * row + i, log_scale[i], by_scales[i]);
}
