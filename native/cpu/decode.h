// What decoding and its derivative say to each other.
#pragma once

#include "column.h"
#include "decoder.h"

namespace vdgs {

// The splats of a view in the order of their anchors: what `Splats` holds, field by field.
struct DecodedView {
  explicit DecodedView(size_t most)
      : means_px(2 * most), conics(3 * most), depths(most), colours(3 * most), opacities(most), volumes(most),
        source(most) {}

  Column<float> means_px, conics, depths, colours, opacities, volumes;
  Column<int32_t> source;
  size_t count = 0;
};

DecodedView decode(const AnchorArrays& anchors, WeightLayout layout, const float* weights, const Camera& camera);

// Gradients of the six outputs (any may be null: zero), and the two outputs that save work.
struct SplatGradients {
  const float *means_px, *conics, *depths, *colours, *opacities, *volumes;
  const float *colour_values, *opacity_values;
  const int32_t* source;
  int64_t count;
};

// Where gradients go (any may be null: not wanted). `weights` is one piece in the layout of WeightLayout.
struct DecodeGradients {
  float *features, *offsets, *log_scales, *weights;
};

void decode_backward(const AnchorArrays& anchors, WeightLayout layout, const float* weights, const Camera& camera,
                     const SplatGradients& in, const DecodeGradients& out);

}  // namespace vdgs
