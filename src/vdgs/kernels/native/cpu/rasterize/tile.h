// What the forward and the backward pass of a tile share: they must agree to the last bit on which
// pixels a splat reaches.
//
// A tile has 4 x 4 blocks of 4 x 4 pixels. A vector is either "one value per block" or "one value per
// pixel of a block"; both number rows first.
#pragma once

#include "cpu/rasterize/frame.h"
#include "simd/simd.h"

namespace vdgs::raster {

alignas(64) constexpr float kLaneX[16] = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
alignas(64) constexpr float kLaneY[16] = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};

// The first pixel center of each block of a tile.
struct BlockOrigins {
  F16 x, y;
  BlockOrigins(const TileGrid& grid, int tile)
      : x(load(kLaneX) * splat(4.0f) + splat(static_cast<float>(tile % grid.columns * kTileSide) + 0.5f)),
        y(load(kLaneY) * splat(4.0f) + splat(static_cast<float>(tile / grid.columns * kTileSide) + 0.5f)) {}
};

// First and last tile of the pixels whose centers lie within `reach` of `mean`, along one axis.
struct TileInterval {
  F16 first, last;
  M16 hit;  // there is such a pixel
};
VDGS_INLINE TileInterval tile_interval(F16 mean, F16 reach, int n_pixels) {
  const F16 center = mean - splat(0.5f);
  const F16 low = splat(0.0f) - floor(reach - center);  // ceil(center - reach)
  const F16 first = max(low, splat(0.0f));
  const F16 last = min(floor(center + reach), splat(static_cast<float>(n_pixels - 1)));
  const F16 per_tile = splat(1.0f / kTileSide);
  return {floor(first * per_tile), floor(last * per_tile), le(first, last)};
}

// u and v of a record (see frame.h) at the first pixel of each block, and from there to each pixel.
struct alignas(64) Falloff {
  float u_block[16], v_block[16], u_pixel[16], v_pixel[16];
};

VDGS_INLINE void make_falloff(const Record& r, F16 dx, F16 dy, Falloff& out) {
  const F16 ux = splat(r.ux), uy = splat(r.uy), vy = splat(r.vy);
  store(out.u_block, fma(ux, dx, uy * dy));
  store(out.v_block, vy * dy);
  store(out.u_pixel, fma(ux, load(kLaneX), uy * load(kLaneY)));
  store(out.v_pixel, vy * load(kLaneY));
}

// Which of sixteen squares a splat may reach: those where the largest exponent over the pixel centers'
// rectangle suffices. dx, dy lead from the mean to the first center of each, `side` from there to the
// last. A concave function is largest on the edge that faces its center, or inside.
VDGS_INLINE M16 squares_in_reach(const Record& r, F16 dx, F16 dy, float side) {
  const F16 zero = splat(0.0f);
  const F16 dx_end = dx + splat(side), dy_end = dy + splat(side);
  const F16 x_near = min(max(zero, dx), dx_end), y_near = min(max(zero, dy), dy_end);
  const F16 y_best = min(max(splat(r.best_y_per_x) * x_near, dy), dy_end);
  const F16 x_best = min(max(splat(r.best_x_per_y) * y_near, dx), dx_end);
  const F16 ux = splat(r.ux), uy = splat(r.uy), vy = splat(r.vy);
  const F16 u1 = fma(ux, x_near, uy * y_best), v1 = vy * y_best;
  const F16 u2 = fma(ux, x_best, uy * y_near), v2 = vy * y_near;
  const F16 loss = min(fma(u1, u1, v1 * v1), fma(u2, u2, v2 * v2));
  return le(loss, splat(r.log2_opacity - (kLog2AlphaMin - kExponentSlack)));
}

// log2 of alpha before the clamp, for the pixels of a block, and u, v there.
struct Exponent {
  F16 u, v, value;
};
VDGS_INLINE Exponent exponent_in_block(const Falloff& f, int block, float log2_opacity) {
  const F16 u = load(f.u_pixel) + splat(f.u_block[block]);
  const F16 v = load(f.v_pixel) + splat(f.v_block[block]);
  return {u, v, fnma(u, u, fnma(v, v, splat(log2_opacity)))};
}
VDGS_INLINE M16 reaches(F16 exponent) { return ge(exponent, splat(kLog2AlphaMin)); }

// Numbers that order as non-negative integers below 2^31 - 2^24 do, exactly: bit patterns of normal
// floats. Larger than all of them: kNever; smaller: 0.
inline float order_of(uint32_t index) {
  const uint32_t u = index + 0x00800000u;
  float order;
  std::memcpy(&order, &u, 4);
  return order;
}
constexpr float kNever = 3.402823466e+38f;

// Whether all pixels of a tile are in the image.
inline bool is_whole(const TileGrid& grid, int tile) {
  return (tile % grid.columns + 1) * kTileSide <= grid.width &&
         (tile / grid.columns + 1) * kTileSide <= grid.height;
}

// Where pixel (x, y) of a tile is, block by block.
inline int place_in_tile(int x, int y) { return ((y >> 2) * 4 + (x >> 2)) * 16 + (y & 3) * 4 + (x & 3); }

// Calls row(y, n, place, pixel) for the tile's rows in the image: n pixels, the first of them at
// `place` in block order (the next four at place + 16, and so on), and at `pixel` of the image.
template <class Row>
VDGS_INLINE void for_each_pixel_row(const TileGrid& grid, int tile, const Row& row) {
  const int x0 = tile % grid.columns * kTileSide, y0 = tile / grid.columns * kTileSide;
  const int n = std::min(kTileSide, grid.width - x0), rows = std::min(kTileSide, grid.height - y0);
  for (int y = 0; y < rows; ++y) row(n, place_in_tile(0, y), static_cast<int64_t>(y0 + y) * grid.width + x0);
}

// Rows of pixels, n <= 16 of them, from and to arrays of the image with 1 or 3 channels.
VDGS_INLINE void write_row(float* image, int n, F16 a) {
  if (n == kTileSide)
    storeu(image, a);
  else
    store_first(image, n, a);
}
VDGS_INLINE void write_row3(float* image, int n, F16 r, F16 g, F16 b) {
  if (n == kTileSide) return store3(image, r, g, b);
  float row[3 * kTileSide];
  store3(row, r, g, b);
  std::memcpy(image, row, static_cast<size_t>(n) * 12);
}
VDGS_INLINE F16 read_row(const float* image, int n) {
  return n == kTileSide ? loadu(image) : load_first(image, n);
}
VDGS_INLINE void read_row3(const float* image, int n, F16& r, F16& g, F16& b) {
  if (n == kTileSide) return load3(image, r, g, b);
  float row[3 * kTileSide] = {};
  std::memcpy(row, image, static_cast<size_t>(n) * 12);
  load3(row, r, g, b);
}

}  // namespace vdgs::raster
