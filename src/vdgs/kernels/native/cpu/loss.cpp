// L1 and SSIM with their gradient, fused.
//
// The image stays interleaved: a row is 3 * width lanes, and the horizontal neighbor of a lane is three
// lanes away. The image is cut into tiles, and each tile is one task that walks down its rows once:
//
//   row r       read the image x and the target y; blur x, y, x²+y², xy along the row        -> moments
//   row r - 5   blur the moments down the column; SSIM and its three derivatives; blur along -> slopes
//   row r - 10  blur the slopes down the column; gradient                                    -> out
//
// Each stage keeps the last 11 rows of its result in a ring, so a tile works within about 400 kB, whatever
// the size of the image. With G the blur, the moments a = Gx, b = Gy, q = G(x²+y²), c = Gxy and
//
//   S = A1 A2 / (B1 B2),   A1 = 2ab + C1,     A2 = 2(c - ab) + C2,
//                          B1 = a² + b² + C1,  B2 = q - a² - b² + C2,
//
// the gradient of sum S is  G(S_a) + 2x G(S_q) + y G(S_c): zero padding makes G its own adjoint.
//
// Where the mask is zero x is replaced by y and neither sum counts the pixel: see torch_ref/loss.py.
// Tiles do not depend on the number of threads, and their sums are added in order: same bits always.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <optional>
#include <tuple>
#include <vector>

#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include "bindings.h"
#include "cpu/buffer.h"
#include "simd/simd.h"
#include "threads.h"

namespace vdgs {
namespace {

constexpr int kTaps = 11;
constexpr int kHalf = kTaps / 2;
constexpr int kMoments = 4;     // x, y, x² + y², xy
constexpr int kSlopes = 3;      // derivatives of S by the moments of x, x² and xy
constexpr int kTileRows = 80;   // at most; a compromise between repeated rows and tasks to share out
constexpr int kTileLanes = 864; // at most; keeps the rings within a small L2 cache
// A tile reads this many lanes either side: twice the reach of the window, in whole vectors.
constexpr int kApron = 32;
// Zeros either side of a line, so that the window may reach over its ends.
constexpr int kPad = 16;
static_assert(kApron >= 2 * 3 * kHalf && kPad >= 3 * kHalf && kApron % kLanes == 0);

constexpr float kC1 = 0.01f * 0.01f;
constexpr float kC2 = 0.03f * 0.03f;

struct Window {
  float weight[kTaps];
  Window() {
    double sum = 0.0;
    for (int i = 0; i < kTaps; ++i) sum += gauss(i);
    for (int i = 0; i < kTaps; ++i) weight[i] = static_cast<float>(gauss(i) / sum);
  }
  static double gauss(int i) { return std::exp(-(i - kHalf) * (i - kHalf) / (2 * 1.5 * 1.5)); }
};
const Window kWindow;

struct Photometric {
  double loss, l1, ssim;
};

struct Images {
  const float* image;
  const uint8_t* target;
  const uint8_t* mask;
  int height, lanes;  // a row has 3 * width lanes
  float* gradient;
  float l1_scale, ssim_scale;  // of the gradients of sum |x - y| and sum S
};

struct Tile {
  int first_row, end_row, first_lane, end_lane;
};

struct Sums {
  double l1 = 0.0, ssim = 0.0;
};

// The rows in flight of one tile. A line covers the lanes of the tile with an apron either side.
class Walk {
 public:
  Walk(const Images& images, const Tile& tile, float* memory);
  static size_t memory_floats(int tile_lanes);
  Sums run();

 private:
  float* line(float* ring, int row, int planes = 1) const {
    return ring + static_cast<size_t>((row + 2 * kTaps) % kTaps) * planes * stride_;
  }
  bool inside(int row) const { return row >= 0 && row < images_.height; }
  // A chunk of the tile proper, not of its apron.
  bool proper(int chunk) const { return chunk >= kApron / kLanes && chunk < chunks_ - kApron / kLanes; }

  void read_row(int row);
  void blur_moments(int row);
  void slope_row(int row);
  void gradient_row(int row);
  void read_mask(int row, float* kept) const;

  const Images& images_;
  const Tile& tile_;
  int chunks_, stride_;      // vectors in a line, floats in a line with its padding
  int read_first_, read_end_;  // lanes of the image that the line holds
  float *x_, *y_, *kept_, *moments_, *slopes_, *scratch_;
  Sums sums_;
};

int line_floats(int tile_lanes) { return tile_lanes + 2 * kApron + 2 * kPad; }

size_t Walk::memory_floats(int tile_lanes) {
  const size_t lines = kTaps * (3 + kMoments + kSlopes) + kMoments;
  return lines * line_floats(tile_lanes);
}

Walk::Walk(const Images& images, const Tile& tile, float* memory) : images_(images), tile_(tile) {
  const int tile_lanes = (tile.end_lane - tile.first_lane + kLanes - 1) / kLanes * kLanes;
  chunks_ = (tile_lanes + 2 * kApron) / kLanes;
  stride_ = line_floats(tile_lanes);
  read_first_ = std::max(0, tile.first_lane - kApron);
  read_end_ = std::min(images.lanes, tile.first_lane + tile_lanes + kApron);
  std::fill(memory, memory + memory_floats(tile_lanes), 0.0f);
  float* next = memory;
  const auto take = [&](int lines) {
    float* taken = next;
    next += static_cast<size_t>(lines) * stride_;
    return taken;
  };
  x_ = take(kTaps), y_ = take(kTaps), kept_ = take(kTaps);
  moments_ = take(kTaps * kMoments), slopes_ = take(kTaps * kSlopes), scratch_ = take(kMoments);
}

Sums Walk::run() {
  const int reach = images_.gradient ? 2 * kHalf : kHalf;
  const int slope_reach = reach - kHalf;
  for (int row = tile_.first_row - reach; row < tile_.end_row + reach; ++row) {
    read_row(row);
    const int slope = row - kHalf;
    if (slope >= tile_.first_row - slope_reach && slope < tile_.end_row + slope_reach) slope_row(slope);
    const int out = row - 2 * kHalf;
    if (images_.gradient && out >= tile_.first_row) gradient_row(out);
  }
  return sums_;
}

// Blur along the row: `lines` planes of one padded line each, to chunks of `planes` vectors.
template <int planes>
VDGS_INLINE void blur_along(const float* const (&lines)[planes], int chunk, float* out) {
  for (int plane = 0; plane < planes; ++plane) {
    const float* at = lines[plane] + kPad + chunk * kLanes;
    F16 sum = load(at) * splat(kWindow.weight[kHalf]);
    for (int k = 1; k <= kHalf; ++k) {
      sum = fma(loadu(at - 3 * k) + loadu(at + 3 * k), splat(kWindow.weight[kHalf - k]), sum);
    }
    store(out + (chunk * planes + plane) * kLanes, sum);
  }
}

// Blur down the column around `row`. Ring slots are visited in their own order and the weights rotate, so
// that addresses advance by a constant.
struct Rotated {
  float weight[kTaps];
  explicit Rotated(int row) {
    for (int k = 0; k < kTaps; ++k) weight[(row - kHalf + k + 2 * kTaps) % kTaps] = kWindow.weight[k];
  }
};
template <int planes>
VDGS_INLINE void blur_down(const float* ring, size_t row_floats, int chunk, const Rotated& window,
                           F16 (&out)[planes]) {
  const float* at = ring + chunk * planes * kLanes;
  for (int plane = 0; plane < planes; ++plane) out[plane] = load(at + plane * kLanes) * splat(window.weight[0]);
  for (int slot = 1; slot < kTaps; ++slot) {
    const F16 weight = splat(window.weight[slot]);
    for (int plane = 0; plane < planes; ++plane) {
      out[plane] = fma(load(at + slot * row_floats + plane * kLanes), weight, out[plane]);
    }
  }
}

void Walk::read_mask(int row, float* kept) const {
  const int offset = kPad + kApron - tile_.first_lane;
  if (!images_.mask) {
    std::fill(kept + offset + read_first_, kept + offset + read_end_, 1.0f);
    return;
  }
  const uint8_t* mask = images_.mask + static_cast<size_t>(row) * (images_.lanes / 3);
  for (int pixel = read_first_ / 3; 3 * pixel < read_end_; ++pixel) {
    const float value = mask[pixel] ? 1.0f : 0.0f;
    for (int i = std::max(3 * pixel, read_first_); i < std::min(3 * pixel + 3, read_end_); ++i) {
      kept[offset + i] = value;
    }
  }
}

// Stage one: the image and the target as floats, and the moments of the row. Outside the image all is zero.
void Walk::read_row(int row) {
  if (!inside(row)) {
    float* moments = line(moments_, row, kMoments);
    std::fill(moments, moments + static_cast<size_t>(kMoments) * stride_, 0.0f);
    return;
  }
  const int offset = kPad + kApron - tile_.first_lane;
  float *x = line(x_, row) + offset, *y = line(y_, row) + offset, *kept = line(kept_, row);
  const float* image = images_.image + static_cast<size_t>(row) * images_.lanes;
  const uint8_t* target = images_.target + static_cast<size_t>(row) * images_.lanes;
  read_mask(row, kept);
  for (int i = read_first_; i < read_end_; ++i) y[i] = static_cast<float>(target[i]) / 255.0f;
  if (images_.mask) {
    for (int i = read_first_; i < read_end_; ++i) x[i] = kept[offset + i] != 0.0f ? image[i] : y[i];
  } else {
    std::copy(image + read_first_, image + read_end_, x + read_first_);
  }
  blur_moments(row);
}

void Walk::blur_moments(int row) {
  const float *x = line(x_, row), *y = line(y_, row);
  float *squares = scratch_, *products = scratch_ + stride_, *moments = line(moments_, row, kMoments);
  F16 l1 = splat(0.0f);
  for (int chunk = 0; chunk < chunks_; ++chunk) {
    const int i = kPad + chunk * kLanes;
    const F16 a = load(x + i), b = load(y + i);
    store(squares + i, fma(a, a, b * b));
    store(products + i, a * b);
    if (proper(chunk)) l1 = l1 + abs(a - b);
  }
  const float* const lines[kMoments] = {x, y, squares, products};
  for (int chunk = 0; chunk < chunks_; ++chunk) blur_along(lines, chunk, moments);
  if (row >= tile_.first_row && row < tile_.end_row) sums_.l1 += hsum(l1);
}

// Stage two: SSIM of a row, its sum over the tile, its slopes blurred along the row.
void Walk::slope_row(int row) {
  float* slopes = line(slopes_, row, kSlopes);
  if (!inside(row)) {
    std::fill(slopes, slopes + static_cast<size_t>(kSlopes) * stride_, 0.0f);
    return;
  }
  const Rotated window(row);
  const float* kept = line(kept_, row) + kPad;
  float* by[kSlopes] = {scratch_, scratch_ + stride_, scratch_ + 2 * stride_};
  const F16 two = splat(2.0f);
  F16 dissimilarity = splat(0.0f);
  for (int chunk = 0; chunk < chunks_; ++chunk) {
    F16 moment[kMoments];
    blur_down(moments_, static_cast<size_t>(kMoments) * stride_, chunk, window, moment);
    const F16 weight = load(kept + chunk * kLanes);
    const F16 a = moment[0], b = moment[1], ab = a * b, sum = fma(a, a, b * b);
    const F16 a1 = fma(two, ab, splat(kC1)), a2 = fma(two, moment[3] - ab, splat(kC2));
    const F16 b1 = sum + splat(kC1), b2 = moment[2] - sum + splat(kC2);
    const F16 inverse = splat(1.0f) / (b1 * b2);
    const F16 similarity = a1 * a2 * inverse;
    if (proper(chunk)) dissimilarity = fma(weight, splat(1.0f) - similarity, dissimilarity);
    const F16 by_square = (splat(0.0f) - similarity) * b1 * inverse;
    const F16 by_product = two * a1 * inverse;
    const F16 by_mean = two * (b * (a2 - a1) * inverse - a * similarity * (b2 - b1) * inverse);
    const int i = kPad + chunk * kLanes;
    store(by[0] + i, weight * by_mean);
    store(by[1] + i, weight * by_square);
    store(by[2] + i, weight * by_product);
  }
  if (row >= tile_.first_row && row < tile_.end_row) sums_.ssim += hsum(dissimilarity);
  if (!images_.gradient) return;
  const float* const lines[kSlopes] = {by[0], by[1], by[2]};
  for (int chunk = 0; chunk < chunks_; ++chunk) blur_along(lines, chunk, slopes);
}

// Stage three: the gradient of a row of the tile.
void Walk::gradient_row(int row) {
  const Rotated window(row);
  const float *x = line(x_, row) + kPad, *y = line(y_, row) + kPad, *kept = line(kept_, row) + kPad;
  float* out = images_.gradient + static_cast<size_t>(row) * images_.lanes;
  const F16 l1_scale = splat(images_.l1_scale), ssim_scale = splat(images_.ssim_scale);
  for (int lane = tile_.first_lane; lane < tile_.end_lane; lane += kLanes) {
    const int at = lane - tile_.first_lane + kApron;
    F16 slope[kSlopes];
    blur_down(slopes_, static_cast<size_t>(kSlopes) * stride_, at / kLanes, window, slope);
    const F16 a = load(x + at), b = load(y + at);
    const F16 ssim = slope[0] + fma(splat(2.0f) * a, slope[1], b * slope[2]);
    const F16 sign = zero_unless(gt(a, b), l1_scale) - zero_unless(lt(a, b), l1_scale);
    const F16 total = fma(ssim_scale, ssim, sign) * load(kept + at);
    const int lanes = tile_.end_lane - lane;
    if (lanes >= kLanes) {
      storeu(out + lane, total);
    } else {
      store_first(out + lane, lanes, total);
    }
  }
}

std::vector<Tile> cut(int height, int lanes) {
  const auto parts = [](int length, int most) { return (length + most - 1) / most; };
  const int bands = parts(height, kTileRows), strips = parts(lanes, kTileLanes);
  const int strip = ((lanes + strips - 1) / strips + kLanes - 1) / kLanes * kLanes;
  std::vector<Tile> tiles;
  for (int band = 0; band < bands; ++band) {
    const auto row = [&](int b) { return static_cast<int>(static_cast<int64_t>(height) * b / bands); };
    for (int lane = 0; lane < lanes; lane += strip) {
      tiles.push_back({row(band), row(band + 1), lane, std::min(lanes, lane + strip)});
    }
  }
  return tiles;
}

int64_t kept_pixels(const uint8_t* mask, int64_t pixels) {
  if (!mask) return pixels;
  int64_t kept = 0;
  for (int64_t i = 0; i < pixels; ++i) kept += mask[i] != 0;
  return kept;
}

Photometric photometric_loss(const float* image, const uint8_t* target, const uint8_t* mask, int height, int width,
                             float ssim_weight, float* gradient) {
  // With nothing kept both sums are zero, whatever they are divided by.
  const double count = 3.0 * std::max<int64_t>(1, kept_pixels(mask, static_cast<int64_t>(height) * width));
  const Images images{image, target, mask, height, 3 * width, gradient,
                      static_cast<float>((1.0 - ssim_weight) / count), static_cast<float>(-ssim_weight / count)};
  const std::vector<Tile> tiles = cut(height, images.lanes);
  std::vector<Sums> sums(tiles.size());
  parallel_for(static_cast<int64_t>(tiles.size()), [&](int64_t i) {
    thread_local Buffer<float> memory;
    const int most_lanes = tiles[i].end_lane - tiles[i].first_lane + kLanes;
    Walk walk(images, tiles[i], memory.reserve(Walk::memory_floats(most_lanes)));
    sums[i] = walk.run();
  });
  Sums total;
  for (const Sums& part : sums) total.l1 += part.l1, total.ssim += part.ssim;
  const double l1 = total.l1 / count, dissimilarity = total.ssim / count;
  return {(1.0 - ssim_weight) * l1 + ssim_weight * dissimilarity, l1, 1.0 - dissimilarity};
}

using Image = Array<const float, nb::ndim<3>>;
using Bytes = Array<const uint8_t, nb::ndim<3>>;
using Mask = Array<const uint8_t, nb::ndim<2>>;
using Gradient = Array<float, nb::ndim<3>>;

std::tuple<double, double, double> bound(Image image, Bytes target, std::optional<Mask> mask, float ssim_weight,
                                         std::optional<Gradient> gradient) {
  const int height = static_cast<int>(image.shape(0)), width = static_cast<int>(image.shape(1));
  nb::gil_scoped_release release;
  const Photometric result = photometric_loss(image.data(), target.data(), mask ? mask->data() : nullptr, height,
                                              width, ssim_weight, gradient ? gradient->data() : nullptr);
  return {result.loss, result.l1, result.ssim};
}

}  // namespace

VDGS_BIND(photometric_loss) {
  m.def("photometric_loss", &bound, nb::arg("image"), nb::arg("target"), nb::arg("mask").none(),
        nb::arg("ssim_weight"), nb::arg("gradient").none());
}

}  // namespace vdgs
