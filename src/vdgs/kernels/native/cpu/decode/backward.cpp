// The derivative of decoding. Nothing but the inputs and the outputs is kept from the forward pass:
// hidden layers and covariances are computed again, sixteen anchors at a time.
//
// The anchors are cut into pieces whose number does not depend on the threads. Each piece sums the
// gradients of the weights in a buffer of its own; the buffers are added in their order. So the same
// bits come out for any number of threads.
#include "cpu/decode/decode.h"

#include <atomic>

#include "threads.h"

namespace vdgs {
namespace {

constexpr int64_t kMostPieces = 128;
constexpr int64_t kSmallestPiece = 256;

// What the splats of a batch bring with them, anchors as lanes.
struct alignas(64) Incoming {
  enum Field { kX, kY, kConicXX, kConicXY, kConicYY, kDepth, kRed, kGreen, kBlue, kOpacity, kVolume,
               kRedValue, kGreenValue, kBlueValue, kOpacityValue, kFields };
  float fields[kMaxOffsets][kFields][kLanes];
  unsigned present[kMaxOffsets];
};

// Gradients of a batch on their way back.
struct alignas(64) Outgoing {
  float outputs[kOutputsPerOffset * kMaxOffsets * kLanes];
  float offsets[3 * kMaxOffsets * kLanes];
  float hidden[kAllHidden * kLanes];
  float features[kFeatures * kLanes];
  float log_scales[kLanes * kLanes];  // six columns are used
};

// Collects the splats from position `s` on that belong to the batch; returns the position behind them.
int64_t collect(const SplatGradients& in, int64_t s, int64_t first, int k, Incoming& out, bool& some) {
  const int64_t begin = first * k, end = (first + kLanes) * k;
  std::memset(out.present, 0, sizeof out.present);
  some = false;
  const auto put = [](float (*fields)[kLanes], int lane, const float* values, int n, int64_t row) {
    for (int i = 0; i < n; ++i) fields[i][lane] = values ? values[row * n + i] : 0.0f;
  };
  for (; s < in.count && in.source[s] < end; ++s) {
    const int within = static_cast<int>(in.source[s] - begin), lane = within / k, j = within % k;
    float(*fields)[kLanes] = out.fields[j];
    put(fields + Incoming::kX, lane, in.means_px, 2, s);
    put(fields + Incoming::kConicXX, lane, in.conics, 3, s);
    put(fields + Incoming::kDepth, lane, in.depths, 1, s);
    put(fields + Incoming::kRed, lane, in.colors, 3, s);
    put(fields + Incoming::kOpacity, lane, in.opacities, 1, s);
    fields[Incoming::kVolume][lane] = in.volumes ? in.volumes[s] : in.volume;
    put(fields + Incoming::kRedValue, lane, in.color_values, 3, s);
    put(fields + Incoming::kOpacityValue, lane, in.opacity_values, 1, s);
    out.present[j] |= 1u << lane;
    some = true;
  }
  return s;
}

// Gradients of one offset's eleven outputs, of the offset itself and of the anchor's log-scales.
void offset_backward(const Camera& camera, const Batch& batch, const float* covariances, const Incoming& in, int j,
                     int k, Outgoing& out) {
  const M16 present = mask_of_bits(in.present[j]);
  const auto field = [&](int f) { return zero_unless(present, load(in.fields[j][f])); };
  const auto put = [&](float* target, F16 value) { store(target, zero_unless(present, value)); };
  const float* o = batch.offsets + 3 * j * kLanes;
  const Vec3<F16> offset = {load(o), load(o + kLanes), load(o + 2 * kLanes)};
  F16 covariance[7];
  for (int i = 0; i < 7; ++i) covariance[i] = load(covariances + (7 * j + i) * kLanes);
  const Gaussian<F16> gaussian = spawn(batch.anchor, offset, covariance);
  const Projection<F16> p = project(camera, gaussian);
  const Footprint<F16> drawn = {field(Incoming::kX), field(Incoming::kY), field(Incoming::kDepth),
                                field(Incoming::kConicXX), field(Incoming::kConicXY), field(Incoming::kConicYY)};
  Gaussian<F16> g = project_backward(camera, gaussian, p, drawn);
  const Vec3<F16> s = gaussian.scale;
  const F16 volume = field(Incoming::kVolume);
  g.scale = g.scale + volume * Vec3<F16>{s.y * s.z, s.z * s.x, s.x * s.y};
  const SpawnGradient<F16> d = spawn_backward(batch.anchor, offset, covariance, gaussian, g);

  const F16 opacity = field(Incoming::kOpacityValue);
  put(out.outputs + j * kLanes, field(Incoming::kOpacity) * fnma(opacity, opacity, splat(1.0f)));
  for (int i = 0; i < 7; ++i) put(out.outputs + (k + 7 * j + i) * kLanes, d.covariance[i]);
  for (int i = 0; i < 3; ++i) {
    const F16 color = field(Incoming::kRedValue + i);
    put(out.outputs + (8 * k + 3 * j + i) * kLanes, field(Incoming::kRed + i) * fnma(color, color, color));
  }
  float* d_offset = out.offsets + 3 * j * kLanes;
  put(d_offset, d.offset.x), put(d_offset + kLanes, d.offset.y), put(d_offset + 2 * kLanes, d.offset.z);
  const F16 logs[6] = {d.log_extent.x, d.log_extent.y, d.log_extent.z, d.log_size.x, d.log_size.y, d.log_size.z};
  for (int i = 0; i < 6; ++i) {
    float* sum = out.log_scales + i * kLanes;
    store(sum, load(sum) + zero_unless(present, logs[i]));
  }
}

// Compiled once: inlined in two places, its products and sums might be rounded in two ways.
[[gnu::noinline]] void offsets_backward(const Camera& camera, WeightLayout layout, const float* weights,
                                        const Batch& batch, const Incoming& in, Outgoing& out) {
  alignas(64) float covariances[7 * kMaxOffsets * kLanes];
  output_layer(layout, weights, 1, batch, covariances);
  const int k = layout.k;
  std::memset(out.log_scales, 0, sizeof out.log_scales);
  for (int j = 0; j < k; ++j) {
    if (in.present[j]) {
      offset_backward(camera, batch, covariances, in, j, k, out);
      continue;
    }
    const size_t lanes = sizeof(float) * kLanes;
    std::memset(out.outputs + j * kLanes, 0, lanes);
    std::memset(out.outputs + (k + 7 * j) * kLanes, 0, 7 * lanes);
    std::memset(out.outputs + (8 * k + 3 * j) * kLanes, 0, 3 * lanes);
    std::memset(out.offsets + 3 * j * kLanes, 0, 3 * lanes);
  }
}

// From the outputs back to the hidden layers.
void hidden_backward(WeightLayout layout, const float* weights, const Batch& batch, Outgoing& out) {
  for (int head = 0; head < kHeads; ++head) {
    const int begin = layout.head_begin(head), unit = head * kHidden;
    multiply<1, kHidden>(
        weights + layout.second() + begin * kHidden, kHidden, kOutputs[head] * layout.k, out.outputs + begin * kLanes,
        [](int) { return splat(0.0f); },
        [&](int r, F16 sum) {
          const M16 active = gt(load(batch.hidden + (unit + r) * kLanes), splat(0.0f));
          store(out.hidden + (unit + r) * kLanes, zero_unless(active, sum));
        });
  }
}

void add_weight_gradients(WeightLayout layout, const Batch& batch, const Outgoing& g, float* sums, float* bias_sums) {
  alignas(64) float rows[kLanes * kAllHidden];
  const auto to_rows = [&](const float* lanes) {
    for (int i = 0; i < kAllHidden; i += kLanes) transpose16(lanes + i * kLanes, kLanes, rows + i, kAllHidden);
  };
  to_rows(g.hidden);
  add_outer_products<kAllHidden, kAllHidden>(batch.inputs, kInputs, rows, sums);
  to_rows(batch.hidden);
  for (int head = 0; head < kHeads; ++head) {
    const int begin = layout.head_begin(head);
    add_outer_products<kHidden, kAllHidden>(g.outputs + begin * kLanes, kOutputs[head] * layout.k,
                                            rows + head * kHidden, sums + layout.second() + begin * kHidden);
  }
  for (int i = 0; i < kOutputsPerOffset * layout.k * kLanes; i += kLanes)
    store(bias_sums + i, load(bias_sums + i) + load(g.outputs + i));
}

// Gradients of the anchors go into arrays.
class IntoArrays {
 public:
  IntoArrays(const AnchorGradients& out, int k) : out_(out), k_(k) {}

  // Where the rows of the anchors from `first` on are to be written.
  AnchorGradients room(int64_t first) const {
    const auto from = [&](float* array, int width) { return array ? array + first * width : nullptr; };
    return {from(out_.features, kFeatures), from(out_.offsets, 3 * k_), from(out_.log_scales, 6)};
  }
  void written(int64_t, int) const {}

 private:
  AnchorGradients out_;
  int k_;
};

// Gradients of the anchors become steps of Adam. No batch reads what another one moves.
class IntoSteps {
 public:
  IntoSteps(const AnchorSteps& steps, const AnchorArrays& anchors, std::atomic<bool>& finite)
      : steps_(steps), anchors_(anchors), finite_(finite) {}

  AnchorGradients room(int64_t) { return {features_, offsets_, log_scales_}; }

  // The rows of `count` anchors are in their room.
  void written(int64_t first, int count) {
    const size_t n = static_cast<size_t>(count);
    if (!all_finite(features_, n * kFeatures) || !all_finite(log_scales_, n * 6) ||
        !all_finite(offsets_, n * steps_.offsets.width))
      return finite_.store(false, std::memory_order_relaxed);
    int64_t rows[kLanes];
    int32_t updates[kLanes];
    for (int i = 0; i < count; ++i) {
      rows[i] = anchors_.row(first + i);
      updates[i] = ++steps_.updates[rows[i]];
    }
    adam_update(steps_.features, rows, n, features_, updates);
    adam_update(steps_.offsets, rows, n, offsets_, updates);
    adam_update(steps_.log_scales, rows, n, log_scales_, updates);
  }

 private:
  const AnchorSteps& steps_;
  const AnchorArrays& anchors_;
  std::atomic<bool>& finite_;
  alignas(64) float features_[kLanes * kFeatures] = {};
  float offsets_[kLanes * 3 * kMaxOffsets] = {}, log_scales_[kLanes * 6] = {};
};

// The gradients of the anchors themselves, as rows.
void write_anchor_gradients(const float* weights, int k, int count, Outgoing& g, const AnchorGradients& out) {
  if (out.features) {
    multiply<kAllHidden, 1>(
        weights, kFeatures, kAllHidden, g.hidden, [](int) { return splat(0.0f); },
        [&](int r, F16 sum) { store(g.features + r * kLanes, sum); });
    lanes_to_rows<kFeatures>(g.features, kFeatures, count, out.features);
  }
  if (out.offsets) lanes_to_rows<3 * kMaxOffsets>(g.offsets, 3 * k, count, out.offsets);
  if (out.log_scales) lanes_to_rows<kLanes>(g.log_scales, 6, count, out.log_scales);
}

void write_no_gradients(int k, int count, const AnchorGradients& out) {
  if (out.features) std::fill_n(out.features, count * kFeatures, 0.0f);
  if (out.offsets) std::fill_n(out.offsets, count * 3 * k, 0.0f);
  if (out.log_scales) std::fill_n(out.log_scales, count * 6, 0.0f);
}

// Anchors begin .. end - 1; `sums` (the gradients of the weights, zeroed here) may be null.
template <class Into>
void piece_backward(const AnchorArrays& anchors, WeightLayout layout, const float* weights, const Camera& camera,
                    const SplatGradients& in, Into into, int64_t begin, int64_t end, float* sums) {
  const int k = layout.k;
  alignas(64) float bias_sums[kOutputsPerOffset * kMaxOffsets * kLanes];
  if (sums) {
    std::fill_n(sums, layout.size(), 0.0f);
    std::fill_n(bias_sums, kOutputsPerOffset * k * kLanes, 0.0f);
  }
  Batch batch;
  Outgoing outgoing;
  auto incoming = std::make_unique<Incoming>();
  int64_t s = std::lower_bound(in.source, in.source + in.count, begin * k) - in.source;
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = static_cast<int>(std::min<int64_t>(kLanes, end - first));
    bool some;
    s = collect(in, s, first, k, *incoming, some);
    const AnchorGradients out = into.room(first);
    if (some) {
      load_batch(anchors, camera, first, batch);
      hidden_layer(weights, batch);
      offsets_backward(camera, layout, weights, batch, *incoming, outgoing);
      if (out.features || sums) hidden_backward(layout, weights, batch, outgoing);
      write_anchor_gradients(weights, k, count, outgoing, out);
      if (sums) add_weight_gradients(layout, batch, outgoing, sums, bias_sums);
    } else {
      write_no_gradients(k, count, out);
    }
    into.written(first, count);
  }
  if (sums)
    for (int i = 0; i < kOutputsPerOffset * k; ++i) sums[layout.bias() + i] = hsum(load(bias_sums + i * kLanes));
}

template <class Into>
void backward(const AnchorArrays& anchors, WeightLayout layout, const float* weights, const Camera& camera,
              const SplatGradients& in, const Into& into, float* weight_gradients) {
  const int64_t share = (anchors.count + kMostPieces - 1) / kMostPieces;
  const int64_t piece = std::max(kSmallestPiece, (share + kLanes - 1) / kLanes * kLanes);
  const int64_t n = (anchors.count + piece - 1) / piece;
  const int64_t size = layout.size();
  const Floats sums = weight_gradients ? make_floats(std::max<int64_t>(1, n * size)) : nullptr;
  parallel_for(n, [&](int64_t i) {
    piece_backward(anchors, layout, weights, camera, in, into, i * piece, std::min(anchors.count, (i + 1) * piece),
                   sums ? sums.get() + i * size : nullptr);
  });
  if (!weight_gradients) return;
  std::fill_n(weight_gradients, size, 0.0f);
  for (int64_t i = 0; i < n; ++i)
    for (int64_t w = 0; w < size; ++w) weight_gradients[w] += sums[i * size + w];
}

}  // namespace

void decode_backward(const AnchorArrays& anchors, WeightLayout layout, const float* weights, const Camera& camera,
                     const SplatGradients& in, const AnchorGradients& out, float* weight_gradients) {
  backward(anchors, layout, weights, camera, in, IntoArrays(out, layout.k), weight_gradients);
}

bool decode_backward_adam(const AnchorArrays& anchors, WeightLayout layout, const float* weights,
                          const Camera& camera, const SplatGradients& in, const AnchorSteps& steps,
                          float* weight_gradients) {
  std::atomic<bool> finite{true};
  backward(anchors, layout, weights, camera, in, IntoSteps(steps, anchors, finite), weight_gradients);
  return finite.load();
}

}  // namespace vdgs
