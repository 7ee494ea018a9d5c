// The decoder's weights as the kernels read them, and sixteen anchors on their way through it.
#pragma once

#include <cstdint>
#include <limits>
#include <memory>

#include "gaussian.h"
#include "cpu/products.h"

namespace vdgs {

constexpr int kFeatures = 32;
constexpr int kInputs = kFeatures + 5;  // feature, direction (3), distance, and one for the bias
constexpr int kHidden = 32;
constexpr int kHeads = 3;  // opacity, covariance, color
constexpr int kAllHidden = kHeads * kHidden;
constexpr int kOutputs[kHeads] = {1, 7, 3};  // per offset
constexpr int kOutputsPerOffset = 11;
constexpr int kMaxOffsets = 32;

// One head as torch.nn.Linear lays it out; `inputs` is 35 or 36.
template <class Scalar>
struct Head {
  Scalar *w1, *b1, *w2, *b2;
  int inputs;
};

// Sixty-four-byte aligned floats.
struct AlignedFree {
  void operator()(float* p) const { ::operator delete[](p, std::align_val_t{64}); }
};
using Floats = std::unique_ptr<float[], AlignedFree>;
inline Floats make_floats(int64_t n) {
  return Floats(static_cast<float*>(::operator new[](static_cast<size_t>(n) * sizeof(float), std::align_val_t{64})));
}

// All weights, or their gradients, in one piece: the first layers of the three heads side by side,
// [input][96] with the bias as last input; the second layers below each other, [11 k][32]; their biases.
struct WeightLayout {
  int k;
  int second() const { return kInputs * kAllHidden; }
  int bias() const { return second() + kOutputsPerOffset * k * kHidden; }
  int size() const { return (bias() + kOutputsPerOffset * k + 15) / 16 * 16; }
  // Where a head's outputs begin among the 11 k.
  int head_begin(int head) const { return head == 0 ? 0 : head == 1 ? k : 8 * k; }
};

// Calls body(one weight of the heads, its place in the layout) for every weight.
template <class Scalar, class Body>
void for_each_weight(WeightLayout layout, const Head<Scalar> (&heads)[kHeads], const Body& body) {
  for (int h = 0; h < kHeads; ++h) {
    const Head<Scalar>& head = heads[h];
    for (int unit = 0; unit < kHidden; ++unit) {
      const int column = h * kHidden + unit;
      for (int i = 0; i < head.inputs; ++i) body(head.w1[unit * head.inputs + i], i * kAllHidden + column);
      body(head.b1[unit], (kInputs - 1) * kAllHidden + column);
    }
    const int outputs = kOutputs[h] * layout.k, begin = layout.head_begin(h);
    for (int i = 0; i < outputs * kHidden; ++i) body(head.w2[i], layout.second() + begin * kHidden + i);
    for (int i = 0; i < outputs; ++i) body(head.b2[i], layout.bias() + begin + i);
  }
}

// The arrays of the model's anchors, contiguous, and which of them are visible.
struct AnchorArrays {
  const float *positions, *features, *offsets, *log_scales;
  int64_t total;        // rows of the arrays
  const int64_t* rows;  // those of the visible anchors; null: row i is visible anchor i
  int64_t count;        // visible anchors
  int k;

  int64_t row(int64_t visible) const { return rows ? rows[visible] : visible; }
};

// Sixteen anchors as lanes; the last of a view are padded with copies of its last.
struct alignas(64) Batch {
  float inputs[kInputs * kLanes];
  float hidden[kAllHidden * kLanes];
  float offsets[kMaxOffsets * 3 * kLanes];
  Anchor<F16> anchor;
  M16 usable;  // there, and all numbers finite
};

// Rows of `width` floats become lanes: out[16 column + lane] is of row chosen[lane]. `out` holds a multiple of
// sixteen columns; those behind `width` are filled with anything. Nothing is read behind `end`.
inline void rows_to_lanes(const float* rows, const float* end, int width, const int64_t (&chosen)[kLanes],
                          float* out) {
  alignas(64) float block[kLanes * kLanes];
  for (int column = 0; column < width; column += kLanes) {
    for (int lane = 0; lane < kLanes; ++lane) {
      const float* from = rows + chosen[lane] * width + column;
      store(block + lane * kLanes,
            from + kLanes <= end ? loadu(from) : load_first(from, std::min(kLanes, width - column)));
    }
    transpose16(block, kLanes, out + column * kLanes, kLanes);
  }
}

// The other way, for the first `count` lanes; `lanes` holds a multiple of sixteen columns.
template <int most>
inline void lanes_to_rows(const float* lanes, int width, int count, float* rows) {
  alignas(64) float all[kLanes * most];
  for (int column = 0; column < width; column += kLanes)
    transpose16(lanes + column * kLanes, kLanes, all + column, most);
  for (int lane = 0; lane < count; ++lane)
    std::memcpy(rows + lane * width, all + lane * most, sizeof(float) * static_cast<size_t>(width));
}

// Anchors first .. first + 15 (or fewer at the end), and the hidden layer of all heads. The inputs of
// anchors that are not usable are zero, so that no NaN of theirs meets another's gradient.
inline void load_batch(const AnchorArrays& anchors, const Camera& camera, int64_t first, Batch& batch) {
  const int count = static_cast<int>(std::min<int64_t>(kLanes, anchors.count - first));
  int64_t chosen[kLanes];  // the last one again where there are no more
  for (int lane = 0; lane < kLanes; ++lane) chosen[lane] = anchors.row(first + std::min(lane, count - 1));
  const auto into_lanes = [&](const float* rows, int width, float* out) {
    rows_to_lanes(rows, rows + anchors.total * width, width, chosen, out);
  };
  alignas(64) float columns[kLanes][kLanes];
  into_lanes(anchors.features, kFeatures, batch.inputs);
  into_lanes(anchors.offsets, 3 * anchors.k, batch.offsets);
  into_lanes(anchors.positions, 3, columns[0]);
  const Vec3<F16> x = {load(columns[0]), load(columns[1]), load(columns[2])};
  into_lanes(anchors.log_scales, 6, columns[0]);
  batch.anchor.position = x;
  batch.anchor.extent = {exp(load(columns[0])), exp(load(columns[1])), exp(load(columns[2]))};
  batch.anchor.size = {exp(load(columns[3])), exp(load(columns[4])), exp(load(columns[5]))};

  const Vec3<F16> center = constant<F16>(camera.center);
  const Vec3<F16> ray = {x.x - center.x, x.y - center.y, x.z - center.z};
  const F16 distance = sqrt(dot(ray, ray));
  const Vec3<F16> direction =
      camera.orthographic ? constant<F16>(camera.forward) : (splat(1.0f) / distance) * ray;
  float* viewing = batch.inputs + kFeatures * kLanes;
  store(viewing, direction.x), store(viewing + kLanes, direction.y), store(viewing + 2 * kLanes, direction.z);
  store(viewing + 3 * kLanes, distance), store(viewing + 4 * kLanes, splat(1.0f));

  // Not by zero times a number: where signs of zero do not count, GCC takes that for zero, of a NaN too.
  const Anchor<F16>& a = batch.anchor;
  const F16 infinity = splat(std::numeric_limits<float>::infinity());
  M16 usable = first_lanes(count);
  for (int i = 0; i < kInputs; ++i) usable = usable & lt(abs(load(batch.inputs + i * kLanes)), infinity);
  for (const Vec3<F16>& v : {a.position, a.extent, a.size}) usable = usable & lt(abs(v.x + v.y + v.z), infinity);
  batch.usable = usable;
  if (bits(batch.usable) != 0xffff)
    for (int i = 0; i < kInputs; ++i) {
      float* input = batch.inputs + i * kLanes;
      store(input, zero_unless(batch.usable, load(input)));
    }
}

// Hidden units of all heads, ReLU.
inline void hidden_layer(const float* weights, Batch& batch) {
  multiply<1, kAllHidden>(
      weights, kAllHidden, kInputs, batch.inputs, [](int) { return splat(0.0f); },
      [&](int r, F16 sum) { store(batch.hidden + r * kLanes, max(sum, splat(0.0f))); });
}

// Outputs of one head before their activations.
inline void output_layer(WeightLayout layout, const float* weights, int head, const Batch& batch, float* out) {
  const int begin = layout.head_begin(head);
  const float* bias = weights + layout.bias() + begin;
  multiply<kHidden, 1>(
      weights + layout.second() + begin * kHidden, kOutputs[head] * layout.k, kHidden,
      batch.hidden + head * kHidden * kLanes, [&](int r) { return splat(bias[r]); },
      [&](int r, F16 sum) { store(out + r * kLanes, sum); });
}

}  // namespace vdgs
