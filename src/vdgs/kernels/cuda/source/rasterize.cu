// Splats to a picture and back: vdgs.kernels.torch_ref.rasterize on a GPU.
//
//   order_splats        which splat comes when among equal depths, where they do not stand in that order
//   splat_tiles         in how many tiles of 16x16 pixels each splat reaches a pixel
//   splat_entries       one entry for each of them: a key (tile, depth) to sort by, and the splat that it is of
//   rasterize_forward   a block of threads a tile, a thread a pixel: the tile's entries front to back
//   rasterize_backward  the same entries in the same order once more: ten sums an entry
//   gather_gradients    adds up the entries of each splat: its gradients
//
// Entries are made splat after splat and sorted in between (by torch, stable, so that equal depths keep the order of the
// splats: that of the rows, or the one that they are given with); the backward pass writes the sums of an entry to where the entry was before sorting, so that those of a splat
// lie side by side. Nothing is added by several threads at once: the same bits every time.
//
// A conic is used by its Cholesky factor, u = ux dx + uy dy and v = vy dy with q = u^2 + v^2: for splats seen edge-on
// a dx^2 + 2 b dx dy + c dy^2 would be all rounding.
#include "image_formation.h"

namespace {

using namespace vdgs;

constexpr int kTile = 16;
constexpr int kThreads = kTile * kTile;
constexpr int kWarp = 32;
constexpr int kWarps = kThreads / kWarp;
constexpr unsigned kAllLanes = 0xffffffffu;
// The backward pass: two pixels a thread, so that sums over a warp, which take most of its time, are made half as often.
constexpr int kPixels = 2;
constexpr int kBackThreads = kThreads / kPixels;
constexpr int kBackWarps = kWarps / kPixels;
// Entries that it has in shared memory at a time.
constexpr int kBatch = 64;
// Of an entry: by log alpha; by u, v; by dx^2, dx dy, dy^2; by three colors; by depth.
constexpr int kSums = 10;
constexpr int kRoom = 16;  // kSums, and zeros up to a power of two

struct Splats {
  const float* means;      // [m, 2]
  const float* conics;     // [m, 3]
  const float* colors;    // [m, 3]
  const float* opacities;  // [m]
  const float* depths;     // [m]
};

struct Shape {
  float x, y;        // the mean
  float ux, uy, vy;  // the Cholesky factor of the conic
  float opacity;
  float reach;  // where q is larger, alpha is surely below 1/255
};

struct Entry {
  Shape shape;
  float color[3];
  float depth;
};

__device__ bool is_finite(float a) { return fabsf(a) <= 3.402823466e38f; }

// False for a splat that is not drawn.
__device__ bool shape_of(const Splats& splats, long long i, Shape& shape) {
  const float x = splats.means[2 * i], y = splats.means[2 * i + 1], opacity = splats.opacities[i];
  const float a = splats.conics[3 * i], b = splats.conics[3 * i + 1], c = splats.conics[3 * i + 2];
  // a c - b^2 with the rounding of b^2 put back (Kahan): of a needle little else is left.
  const float square = b * b;
  const float determinant = fmaf(a, c, -square) + fmaf(-b, b, square);
  const bool finite = is_finite(x) && is_finite(y) && is_finite(a) && is_finite(b) && is_finite(c) &&
                      is_finite(opacity) && is_finite(splats.depths[i]) && is_finite(splats.colors[3 * i]) &&
                      is_finite(splats.colors[3 * i + 1]) && is_finite(splats.colors[3 * i + 2]);
  if (!(finite && a > 0.0f && c > 0.0f && determinant > 0.0f && opacity >= kAlphaMin)) return false;
  const float ux = sqrtf(a);
  shape = {x, y, ux, b / ux, sqrtf(determinant / a), opacity, fmaf(2.0002f, logf(opacity / kAlphaMin), 1e-3f)};
  return true;
}

__device__ float along(const Shape& s, float dx, float dy) { return fmaf(s.ux, dx, s.uy * dy); }
__device__ float square_of(float u, float v) { return fmaf(u, u, v * v); }
__device__ float quadratic(const Shape& s, float dx, float dy) { return square_of(along(s, dx, dy), s.vy * dy); }
__device__ float clamped(float a, float low, float high) { return fminf(fmaxf(a, low), high); }
// Alpha before it is clamped. The card's own exponential is off by 1e-6 at most, for the q that reach here.
__device__ float alpha_of(const Shape& s, float q) { return s.opacity * __expf(-0.5f * q); }

// Whether a splat may reach a pixel's center of a tile: the least q over the rectangle of centers lies at the mean or on
// the border. The rectangle is widened a little, for rounding.
__device__ bool touches(const Shape& s, int column, int row) {
  const float slack = 0.01f;
  const float left = static_cast<float>(column * kTile) + 0.5f - s.x - slack, right = left + (kTile - 1) + 2 * slack;
  const float top = static_cast<float>(row * kTile) + 0.5f - s.y - slack, bottom = top + (kTile - 1) + 2 * slack;
  if (left <= 0.0f && right >= 0.0f && top <= 0.0f && bottom >= 0.0f) return true;
  const float tilt = -s.ux * s.uy / square_of(s.uy, s.vy), lean = -s.uy / s.ux;
  const float nearest = fminf(fminf(quadratic(s, left, clamped(tilt * left, top, bottom)),
                                    quadratic(s, right, clamped(tilt * right, top, bottom))),
                              fminf(quadratic(s, clamped(lean * top, left, right), top),
                                    quadratic(s, clamped(lean * bottom, left, right), bottom)));
  return nearest <= s.reach;
}

struct Box {
  int left, right, top, bottom;  // tiles, both ends included; empty if right < left or bottom < top
};

__device__ Box box_of(const Shape& s, int columns, int rows) {
  const float across = sqrtf(s.reach * square_of(s.uy, s.vy)) / (s.ux * s.vy), down = sqrtf(s.reach) / s.vy;
  const float side = kTile, most_columns = static_cast<float>(columns - 1), most_rows = static_cast<float>(rows - 1);
  // Compared as floats: they may be infinite.
  return {static_cast<int>(clamped(ceilf((s.x - across - side) / side), 0.0f, most_columns + 1.0f)),
          static_cast<int>(clamped(floorf((s.x + across) / side), -1.0f, most_columns)),
          static_cast<int>(clamped(ceilf((s.y - down - side) / side), 0.0f, most_rows + 1.0f)),
          static_cast<int>(clamped(floorf((s.y + down) / side), -1.0f, most_rows))};
}

// Orders as the depth does; both zeros are one.
__device__ unsigned depth_bits(float depth) {
  const unsigned bits = __float_as_uint(depth + 0.0f);
  return bits & 0x80000000u ? ~bits : bits | 0x80000000u;
}

// Pixels of a warp lie together, 8x4 of them.
__device__ int pixel_column() { return blockIdx.x * kTile + threadIdx.x / kWarp % 2 * 8 + threadIdx.x % 8; }
__device__ int pixel_row() { return blockIdx.y * kTile + threadIdx.x / kWarp / 2 * 4 + threadIdx.x % kWarp / 8; }

__device__ void read_entry(const Splats& splats, long long i, Entry& entry) {
  shape_of(splats, i, entry.shape);  // only splats that are drawn have entries
  for (int k = 0; k < 3; ++k) entry.color[k] = splats.colors[3 * i + k];
  entry.depth = splats.depths[i];
}

// What the backward pass keeps of a pixel.
struct PixelBack {
  float y, wanted[3], wanted_depth;
  float rest;     // the light behind what was looked at, as the gradient sees it
  float through;  // transmittance
  int until;      // entries that it looks at
};

// Adds what an entry does to a pixel to its sums. False: nothing.
__device__ bool add_pixel(const Entry& entry, float dx, bool reached, PixelBack& pixel, float (&values)[kRoom]) {
  const Shape& s = entry.shape;
  const float dy = pixel.y - s.y;
  const float u = along(s, dx, dy), v = s.vy * dy, q = square_of(u, v);
  if (!reached || q > s.reach) return false;
  const float free = alpha_of(s, q), alpha = fminf(free, kAlphaMax);
  if (alpha < kAlphaMin) return false;
  const float weight = alpha * pixel.through;
  float value = pixel.wanted_depth * entry.depth;
  for (int k = 0; k < 3; ++k) {
    value = fmaf(pixel.wanted[k], entry.color[k], value);
    values[6 + k] = fmaf(weight, pixel.wanted[k], values[6 + k]);
  }
  values[9] = fmaf(weight, pixel.wanted_depth, values[9]);
  pixel.rest = fmaf(-weight, value, pixel.rest);
  const float by_alpha = pixel.through * value - __fdividef(pixel.rest, 1.0f - alpha);
  pixel.through *= 1.0f - alpha;
  if (free <= kAlphaMax) {
    const float by_log = by_alpha * alpha, by_q = -0.5f * by_log;
    values[0] += by_log;
    values[1] = fmaf(by_q, u, values[1]), values[2] = fmaf(by_q, v, values[2]);
    values[3] = fmaf(by_q * dx, dx, values[3]), values[4] = fmaf(by_q * dx, dy, values[4]);
    values[5] = fmaf(by_q * dy, dy, values[5]);
  }
  return true;
}

// Adds kRoom numbers of each lane over the warp: lane l returns the sum of the number l / 2. Half of what a lane still
// has goes to its partner at each step, so that 16 exchanges do for 16 numbers.
__device__ float add_over_warp(float (&values)[kRoom]) {
  const int lane = threadIdx.x % kWarp;
#pragma unroll
  for (int half = kRoom / 2; half >= 1; half /= 2) {
    const bool upper = lane & (2 * half);
#pragma unroll
    for (int i = 0; i < half; ++i) {
      const float kept = upper ? values[half + i] : values[i], given = upper ? values[i] : values[half + i];
      values[i] = kept + __shfl_xor_sync(kAllLanes, given, 2 * half);
    }
  }
  return values[0] + __shfl_xor_sync(kAllLanes, values[0], 1);
}

}  // namespace

// A warp a run of splats that stand in order. `begins` [runs]: where in memory; `ends` [runs]: where among all.
extern "C" __global__ void __launch_bounds__(kThreads)
order_splats(const int* begins, const int* ends, int runs, int* order) {
  const long long run = static_cast<long long>(blockIdx.x) * kWarps + threadIdx.x / kWarp;
  if (run >= runs) return;
  const int first = run ? ends[run - 1] : 0, length = ends[run] - first, begin = begins[run];
  for (int i = threadIdx.x % kWarp; i < length; i += kWarp) order[first + i] = begin + i;
}

// A thread a splat. `order` [m]: the row of the splat that comes first, and so on (null: as the rows are). `tiles` [m], in
// this order.
extern "C" __global__ void __launch_bounds__(kThreads)
splat_tiles(const float* means, const float* conics, const float* colors, const float* opacities, const float* depths,
            const int* order, long long count, int columns, int rows, long long* tiles) {
  const long long place = static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x;
  if (place >= count) return;
  const long long i = order ? order[place] : place;
  const Splats splats{means, conics, colors, opacities, depths};
  Shape shape;
  long long found = 0;
  if (shape_of(splats, i, shape)) {
    const Box box = box_of(shape, columns, rows);
    for (int row = box.top; row <= box.bottom; ++row)
      for (int column = box.left; column <= box.right; ++column) found += touches(shape, column, row);
  }
  tiles[place] = found;
}

// A thread a splat, in their `order`. `ends` [m]: where the entries of each splat end. `keys` and `owners`: one for each entry.
extern "C" __global__ void __launch_bounds__(kThreads)
splat_entries(const float* means, const float* conics, const float* colors, const float* opacities,
              const float* depths, const int* order, long long count, int columns, int rows, const long long* ends,
              long long* keys, int* owners) {
  const long long place = static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x;
  if (place >= count) return;
  const long long i = order ? order[place] : place;
  const Splats splats{means, conics, colors, opacities, depths};
  Shape shape;
  if (!shape_of(splats, i, shape)) return;
  const Box box = box_of(shape, columns, rows);
  const long long depth = depth_bits(depths[i]);
  long long at = place ? ends[place - 1] : 0;
  for (int row = box.top; row <= box.bottom; ++row)
    for (int column = box.left; column <= box.right; ++column) {
      if (!touches(shape, column, row)) continue;
      keys[at] = (static_cast<long long>(row) * columns + column) << 32 | depth;
      owners[at] = static_cast<int>(i);
      ++at;
    }
}

// A block a tile. `order`: where each sorted entry was before; `bounds` [tiles + 1]: where those of a tile begin.
// `last` [h, w]: how many entries of its tile a pixel looks at before it is finished. Depth and median may be null.
extern "C" __global__ void __launch_bounds__(kThreads)
rasterize_forward(const float* means, const float* conics, const float* colors, const float* opacities,
                  const float* depths, const int* owners, const long long* order, const long long* bounds,
                  const float* background, int width, int height, float* image, float* transmittance, int* last,
                  float* depth, float* median) {
  __shared__ Entry batch[kThreads];
  const Splats splats{means, conics, colors, opacities, depths};
  const int column = pixel_column(), row = pixel_row();
  const bool inside = column < width && row < height;
  const float x = static_cast<float>(column) + 0.5f, y = static_cast<float>(row) + 0.5f;
  const long long tile = static_cast<long long>(blockIdx.y) * gridDim.x + blockIdx.x;
  const long long first = bounds[tile];
  const int count = static_cast<int>(bounds[tile + 1] - first);
  bool finished = !inside;
  int looked_at = count;
  float through = 1.0f, color[3] = {0.0f, 0.0f, 0.0f}, mean_depth = 0.0f, half_depth = 0.0f;
  for (int begin = 0; begin < count; begin += kThreads) {
    if (__syncthreads_and(finished)) break;  // and before the batch is written anew
    const int size = count - begin < kThreads ? count - begin : kThreads;
    if (threadIdx.x < size) read_entry(splats, owners[order[first + begin + threadIdx.x]], batch[threadIdx.x]);
    __syncthreads();
    for (int i = 0; i < size && !finished; ++i) {
      const Shape& s = batch[i].shape;
      const float q = quadratic(s, x - s.x, y - s.y);
      if (q > s.reach) continue;
      const float alpha = fminf(alpha_of(s, q), kAlphaMax);
      if (alpha < kAlphaMin) continue;
      const float behind = through * (1.0f - alpha);
      if (behind < kTransmittanceMin) {
        finished = true;
        looked_at = begin + i;
        continue;
      }
      const float weight = alpha * through;
      for (int k = 0; k < 3; ++k) color[k] = fmaf(weight, batch[i].color[k], color[k]);
      mean_depth = fmaf(weight, batch[i].depth, mean_depth);
      if (through >= kMedianTransmittance && behind < kMedianTransmittance) half_depth = batch[i].depth;
      through = behind;
    }
  }
  if (!inside) return;
  const long long pixel = static_cast<long long>(row) * width + column;
  for (int k = 0; k < 3; ++k) image[3 * pixel + k] = fmaf(through, background[k], color[k]);
  transmittance[pixel] = through;
  last[pixel] = looked_at;
  if (depth) depth[pixel] = mean_depth;
  if (median) median[pixel] = half_depth;
}

// A block a tile. Gradients by image, alpha and depth may be null; `sums` [entries, kSums] hold zeros, and go on to do so
// for all splats but the first `kept`, whose gradients alone are wanted.
//
// With `value` = color . gradient (+ depth): the light behind a splat, as the gradient sees it, is what the whole pixel
// shows without what is in front of it and itself: no transmittance has to be divided out of what was multiplied.
extern "C" __global__ void __launch_bounds__(kBackThreads, 7)
rasterize_backward(const float* means, const float* conics, const float* colors, const float* opacities,
                   const float* depths, const int* owners, const long long* order, const long long* bounds, int width,
                   int height, const float* image, const float* transmittance, const int* last, const float* depth,
                   const float* by_image, const float* by_alpha, const float* by_depth, long long kept, float* sums) {
  __shared__ Entry batch[kBatch];
  __shared__ bool keeps[kBatch];  // whether the sums of an entry are wanted
  __shared__ long long slots[kBatch];
  __shared__ float parts[kBackWarps][kBatch][kSums];
  const Splats splats{means, conics, colors, opacities, depths};
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  // Pixels of a warp lie together, 8x8 of them: those of a thread four rows apart.
  const int column = blockIdx.x * kTile + warp % 2 * 8 + lane % 8, row = blockIdx.y * kTile + warp / 2 * 8 + lane / 8;
  const float x = static_cast<float>(column) + 0.5f;
  const long long tile = static_cast<long long>(blockIdx.y) * gridDim.x + blockIdx.x, first = bounds[tile];
  PixelBack pixels[kPixels];
  int until = 0;
#pragma unroll
  for (int p = 0; p < kPixels; ++p) {
    const int its_row = row + 4 * p;
    pixels[p] = {static_cast<float>(its_row) + 0.5f, {0.0f, 0.0f, 0.0f}, 0.0f, 0.0f, 1.0f, 0};
    if (column >= width || its_row >= height) continue;
    const long long pixel = static_cast<long long>(its_row) * width + column;
    pixels[p].until = last[pixel];
    for (int k = 0; k < 3 && by_image; ++k) {
      pixels[p].wanted[k] = by_image[3 * pixel + k];
      pixels[p].rest = fmaf(image[3 * pixel + k], pixels[p].wanted[k], pixels[p].rest);
    }
    if (by_depth) {
      pixels[p].wanted_depth = by_depth[pixel];
      pixels[p].rest = fmaf(depth[pixel], pixels[p].wanted_depth, pixels[p].rest);
    }
    if (by_alpha) pixels[p].rest = fmaf(-transmittance[pixel], by_alpha[pixel], pixels[p].rest);
    until = pixels[p].until > until ? pixels[p].until : until;
  }
  for (int begin = 0; __syncthreads_or(begin < until); begin += kBatch) {  // and before the batch is written anew
    const long long end = bounds[tile + 1] - first;
    const int size = end - begin < kBatch ? static_cast<int>(end - begin) : kBatch;
    if (threadIdx.x < size) {
      slots[threadIdx.x] = order[first + begin + threadIdx.x];
      const int owner = owners[slots[threadIdx.x]];
      read_entry(splats, owner, batch[threadIdx.x]);
      keeps[threadIdx.x] = owner < kept;
    }
    __syncthreads();
    for (int i = 0; i < size; ++i) {
      float values[kRoom] = {};
      bool counts = false;
#pragma unroll
      for (int p = 0; p < kPixels; ++p)
        counts |= add_pixel(batch[i], x - batch[i].shape.x, begin + i < pixels[p].until, pixels[p], values);
      if (!keeps[i]) continue;  // the same for all threads
      float sum = 0.0f;
      if (__any_sync(kAllLanes, counts)) sum = add_over_warp(values);
      if (lane % 2 == 0 && lane / 2 < kSums) parts[warp][i][lane / 2] = sum;
    }
    __syncthreads();
    for (int k = threadIdx.x; k < size * kSums; k += kBackThreads) {
      if (!keeps[k / kSums]) continue;
      float total = 0.0f;
      for (int w = 0; w < kBackWarps; ++w) total += parts[w][k / kSums][k % kSums];
      sums[slots[k / kSums] * kSums + k % kSums] = total;
    }
  }
}

// A thread a splat, in their `order`. Gradients are those of the first `kept` rows; they may overwrite means and conics;
// `by_depths` may be null.
extern "C" __global__ void __launch_bounds__(kThreads)
gather_gradients(const float* means, const float* conics, const float* colors, const float* opacities,
                 const float* depths, const int* order, long long count, const long long* ends, const float* sums,
                 long long kept, float* by_means, float* by_conics, float* by_colors, float* by_opacities, float* by_depths) {
  const long long place = static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x;
  if (place >= count) return;
  const long long i = order ? order[place] : place;
  if (i >= kept) return;
  float total[kSums] = {};
  for (long long entry = place ? ends[place - 1] : 0; entry < ends[place]; ++entry)
    for (int k = 0; k < kSums; ++k) total[k] += sums[entry * kSums + k];
  Shape s{};
  const bool drawn = shape_of({means, conics, colors, opacities, depths}, i, s);
  by_means[2 * i] = -2.0f * s.ux * total[1];
  by_means[2 * i + 1] = -2.0f * fmaf(s.uy, total[1], s.vy * total[2]);
  by_conics[3 * i] = total[3];
  by_conics[3 * i + 1] = 2.0f * total[4];
  by_conics[3 * i + 2] = total[5];
  for (int k = 0; k < 3; ++k) by_colors[3 * i + k] = total[6 + k];
  by_opacities[i] = drawn ? total[0] / s.opacity : 0.0f;
  if (by_depths) by_depths[i] = total[9];
}
