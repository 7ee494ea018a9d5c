// Differentiable rasterizer of projected Gaussians ("splats") for the CPU.
//
// The image formation model is that of 3D Gaussian splatting (Kerbl et al. 2023, eqs. 2-3), front to back:
//
//     alpha_i = min(0.999, opacity_i exp(-1/2 (a dx^2 + 2 b dx dy + c dy^2)))   skipped below 1/255
//     color  = sum_i color_i alpha_i T_i + T background,   T_i = product of (1 - alpha_j), j before i
//
// where a pixel is finished before T would fall below 1e-4. The median depth of a pixel is that of the
// splat at which T falls from at least 1/2 to below it; it has no derivative. How it is made fast:
//
//   cull      which splats can reach a pixel, sixteen at a time                  cull.cpp
//   slabs     a few ranges of depth, front to back; a tile of 16 x 16 pixels that
//             is finished takes no part in the slabs behind, so that what is hidden
//             is never sorted or binned                                          slabs.cpp
//   records   what the tiles need of a splat, in one cache line                  records.cpp
//   bin       the entries of each tile, in the order of depth                    bin.cpp
//   forward   per tile: sixteen blocks of 4 x 4 pixels, one vector each          forward.cpp
//   backward  per tile, back to front; ten sums per entry                        backward.cpp
//   shares    or front to back, what the entries make of a picture: four sums    shares.cpp
//   reduce    the entries of a splat added up, in a fixed order                  reduce.cpp
//
// No atomics on numbers anywhere: the same input gives the same bits for any number of threads.
#pragma once

#include <cstdint>

namespace vdgs::raster {

// Rows of n splats, contiguous. A splat with a value that is not finite, or whose conic is not
// positive definite, is not drawn.
struct Splats {
  int64_t count;
  const float* means;      // [n, 2] pixels
  const float* conics;     // [n, 3] a, b, c
  const float* colors;    // [n, 3]
  const float* opacities;  // [n]
  const float* depths;     // [n]
};

struct Picture {
  float* image;         // [h, w, 3]
  float* alpha;         // [h, w]: 1 - T
  float* depth;         // [h, w]: sum of w_i depth_i; null if not wanted
  float* median_depth;  // [h, w]: depth_i at which T falls below 1/2, else 0; null where depth is
};

struct PictureGradients {
  const float* image;  // any of the three may be null: zero
  const float* alpha;
  const float* depth;
};

// Of the first `count` splats, which may be all. All overwritten, zero for splats that were not drawn.
struct SplatGradients {
  int64_t count;
  float* means;
  float* conics;
  float* colors;
  float* opacities;
  float* depths;      // null if the depth was not wanted
  float* background;  // [3]
};

struct Frame;  // what the backward pass needs to know; see frame.h

// Draws; `counting` also counts the contributing pairs of splat and pixel (frame.stats).
void forward(Frame& frame, const Splats& splats, const float background[3], int width, int height,
             const Picture& out, bool counting);

// May be called more than once for one forward pass, but not at the same time.
void backward(Frame& frame, const float background[3], const PictureGradients& in, const SplatGradients& out);

// In place of the backward pass, where derivatives by colors suffice. Of each splat the sum of its weights
// over the pixels [n], and that of weight times `lacking` [h, w, 3] there [n, 3]; zero for splats that were not drawn.
void shares(Frame& frame, const float* lacking, float* pixels, float* missing);

}  // namespace vdgs::raster
