// The sums over pixels that the backward pass makes of every entry of a tile.
//
// s is dL/d(ln alpha) where alpha is not clamped, w the weight alpha T, G the picture's gradient.
#pragma once

namespace vdgs::raster {

enum Sum {
  kSum,       // s
  kSumU,      // s u
  kSumV,      // s v
  kSumUU,     // s u^2
  kSumUV,     // s u v
  kSumVV,     // s v^2
  kSumRed,    // w G_red
  kSumGreen,  // w G_green
  kSumBlue,   // w G_blue
  kSumDepth,  // w G_depth, if there is a depth
};

constexpr int n_sums(bool with_depth) { return with_depth ? 10 : 9; }

}  // namespace vdgs::raster
