// What decoding and its derivative say to each other.
#pragma once

#include "cpu/adam.h"
#include "cpu/column.h"
#include "cpu/decode/decoder.h"

namespace vdgs {

// The splats of a view in the order of their anchors: what `Splats` holds, field by field.
struct DecodedView {
  explicit DecodedView(size_t most)
      : means_px(2 * most), conics(3 * most), depths(most), colors(3 * most), opacities(most), volumes(most),
        source(most) {}

  Column<float> means_px, conics, depths, colors, opacities, volumes;
  Column<int32_t> source;
  size_t count = 0;
};

DecodedView decode(const AnchorArrays& anchors, WeightLayout layout, const float* weights, const Camera& camera);

// Gradients of the six outputs (any may be null: zero, but for the volumes, whose gradient is the same number
// then), and the two outputs that save work.
struct SplatGradients {
  const float *means_px, *conics, *depths, *colors, *opacities, *volumes;
  float volume;
  const float *color_values, *opacity_values;
  const int32_t* source;
  int64_t count;
};

// Where gradients of visible anchors go, row by row (any may be null: not wanted).
struct AnchorGradients {
  float *features, *offsets, *log_scales;
};

// `weight_gradients` is one piece in the layout of WeightLayout, or null: not wanted.
void decode_backward(const AnchorArrays& anchors, WeightLayout layout, const float* weights, const Camera& camera,
                     const SplatGradients& in, const AnchorGradients& out, float* weight_gradients);

// The anchors' parameters, on their way to the next step, and how many each anchor has made: counted up with them.
struct AnchorSteps {
  AdamRows features, offsets, log_scales;
  int32_t* updates;
};

// As decode_backward, but the visible anchors make their step of Adam as soon as their gradients are known, so
// that these are never held. False, and some anchors have moved while others have not: a gradient is not finite.
bool decode_backward_adam(const AnchorArrays& anchors, WeightLayout layout, const float* weights,
                          const Camera& camera, const SplatGradients& in, const AnchorSteps& steps,
                          float* weight_gradients);

}  // namespace vdgs
