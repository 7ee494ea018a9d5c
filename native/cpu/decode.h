// What decoding and its derivative say to each other.
#pragma once

#include <vector>

#include "decoder.h"

namespace vdgs {

// A splat on its way out of the decoder: what `Splats` holds, in one piece of sixteen words, so that
// sixteen splats are a transpose and one splat is one register.
struct Splat {
  float x, y, conic_xx, conic_xy, conic_yy, depth, red, green, blue, opacity, volume;
  int32_t source;
  float unused[4];
};
static_assert(sizeof(Splat) == 16 * sizeof(float));

// Room for the splats of a piece of consecutive anchors.
struct Piece {
  std::unique_ptr<Splat[]> splats;
  int64_t capacity = 0, count = 0;
};

// The splats of a view in order. Their memory goes back to a store when the view is destroyed, since
// the system asks for more time to hand out fresh pages than it takes to fill them.
struct DecodedView {
  std::vector<Piece> pieces;
  int64_t count = 0;

  DecodedView() = default;
  DecodedView(DecodedView&&) = default;
  DecodedView& operator=(DecodedView&&) = default;
  ~DecodedView();
};

struct SplatArrays {
  float *means_px, *conics, *depths, *colours, *opacities, *volumes;
  int32_t* source;
};

DecodedView decode(const AnchorArrays& anchors, WeightLayout layout, const float* weights, const Camera& camera);
void write_splats(const DecodedView& view, const SplatArrays& out);

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
