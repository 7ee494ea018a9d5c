// Records in depth order, and which splats each tile has to look at.
#include <cmath>
#include <stdexcept>

#include "frame.h"
#include "simd.h"
#include "threads.h"

namespace vdgs::raster {
namespace {

// Sixteen splats of a part, field by field.
struct alignas(64) Sixteen {
  float x[16], y[16], a[16], b[16], c[16], det[16], opacity[16];
  float ux[16], uy[16], vy[16], log2_opacity[16], best_y[16], best_x[16], reach_x[16], reach_y[16];
};

void prefetch(const Splats& s, int64_t i) {
  __builtin_prefetch(s.means + 2 * i);
  __builtin_prefetch(s.conics + 3 * i);
  __builtin_prefetch(s.colours + 3 * i);
  __builtin_prefetch(s.opacities + i);
}

void gather_splats(const Splats& s, const DepthKey* order, int n, Sixteen& out) {
  for (int k = 0; k < n; ++k) {
    const int64_t i = order[k].splat;
    const float a = s.conics[3 * i], b = s.conics[3 * i + 1], c = s.conics[3 * i + 2];
    out.x[k] = s.means[2 * i], out.y[k] = s.means[2 * i + 1];
    out.a[k] = a, out.b[k] = b, out.c[k] = c;
    // In double the products are exact: a splat seen edge-on keeps the right width.
    out.det[k] = static_cast<float>(static_cast<double>(a) * c - static_cast<double>(b) * b);
    out.opacity[k] = s.opacities[i];
  }
}

VDGS_INLINE void derive(Sixteen& s) {
  const F16 a = load(s.a), b = load(s.b), c = load(s.c), det = load(s.det);
  const F16 inverse_a = splat(1.0f) / a, b_over_a = b * inverse_a;
  const F16 log2_opacity = log2(load(s.opacity));
  const F16 scale = (log2_opacity - splat(kLog2AlphaMin - kExponentSlack)) * splat(1.0f / kHalfLog2E) / det;
  const F16 ux = sqrt(splat(kHalfLog2E) * a);
  store(s.ux, ux);
  store(s.uy, ux * b_over_a);
  store(s.vy, sqrt(splat(kHalfLog2E) * det * inverse_a));
  store(s.log2_opacity, log2_opacity);
  store(s.best_y, splat(0.0f) - b / c);
  store(s.best_x, splat(0.0f) - b_over_a);
  store(s.reach_x, sqrt(scale * c));
  store(s.reach_y, sqrt(scale * a));
}

// The key is a bijection of the depth: no need to fetch it again.
float depth_of_key(uint32_t key) {
  const uint32_t u = key ^ (key >> 31 ? 0x80000000u : 0xffffffffu);
  float depth;
  std::memcpy(&depth, &u, 4);
  return depth;
}

// False if the splat is not to be drawn after all.
bool write_record(const Sixteen& s, int k, const float* colour, uint32_t key, Record& r) {
  r = Record{s.x[k], s.y[k], s.ux[k], s.uy[k], s.vy[k], s.log2_opacity[k], {colour[0], colour[1], colour[2]},
             depth_of_key(key), s.best_y[k], s.best_x[k], s.reach_x[k], s.reach_y[k], s.opacity[k], 0.0f};
  const float total = std::fabs(colour[0]) + std::fabs(colour[1]) + std::fabs(colour[2]);
  return s.det[k] > 0.0f && total < __builtin_inff();
}

// First and last pixel whose centre lies in [low, high], within the image; none if first > last.
struct PixelInterval {
  int first, last;
};
PixelInterval pixels_between(float low, float high, int n_pixels) {
  const float limit = static_cast<float>(n_pixels);
  return {static_cast<int>(std::ceil(std::min(std::max(low - 0.5f, 0.0f), limit))),
          static_cast<int>(std::floor(std::max(std::min(high - 0.5f, limit - 1.0f), -1.0f)))};
}

// Calls visit(row, first_column, last_column) for the tiles that the ellipse alpha >= 1/255 reaches.
template <class Visit>
void for_each_tile_row(const Record& r, const TileGrid& grid, const Visit& visit) {
  const PixelInterval x = pixels_between(r.mean_x - r.reach_x, r.mean_x + r.reach_x, grid.width);
  const PixelInterval y = pixels_between(r.mean_y - r.reach_y, r.mean_y + r.reach_y, grid.height);
  if (x.first > x.last || y.first > y.last) return;
  const int column0 = x.first / kTileSide, column1 = x.last / kTileSide;
  const int row0 = y.first / kTileSide, row1 = y.last / kTileSide;
  if (column0 == column1 || row0 == row1) {  // the box is exact enough
    for (int row = row0; row <= row1; ++row) visit(row, column0, column1);
    return;
  }
  // On a line at dy the ellipse spans  (-uy dy +- sqrt(limit - (vy dy)^2)) / ux.
  const float limit = r.log2_opacity - (kLog2AlphaMin - kExponentSlack);
  const float inverse_ux = 1.0f / r.ux, slack = 2e-3f;
  const float dy_of_rightmost = r.best_y_per_x * r.reach_x;
  const auto root = [&](float dy) { return std::sqrt(std::max(0.0f, limit - r.vy * dy * (r.vy * dy))); };
  for (int row = row0; row <= row1; ++row) {
    const float top = static_cast<float>(row * kTileSide) + 0.5f - r.mean_y;
    const float low = std::max(top, -r.reach_y), high = std::min(top + (kTileSide - 1), r.reach_y);
    const float dy_right = std::min(std::max(dy_of_rightmost, low), high);
    const float dy_left = std::min(std::max(-dy_of_rightmost, low), high);
    const float right = (root(dy_right) - r.uy * dy_right) * inverse_ux + slack;
    const float left = (-root(dy_left) - r.uy * dy_left) * inverse_ux - slack;
    const PixelInterval span = pixels_between(r.mean_x + left, r.mean_x + right, grid.width);
    const int first = std::max(x.first, span.first), last = std::min(x.last, span.last);
    if (first <= last) visit(row, first / kTileSide, last / kTileSide);
  }
}

// Notes the tiles of one splat in part.where and counts them in part.cursor.
void note_tiles(const Frame& frame, const Record& r, SlabPart& part) {
  const TileGrid& grid = frame.grid;
  size_t n = static_cast<size_t>(part.n_entries);
  for_each_tile_row(r, grid, [&](int row, int column0, int column1) {
    uint32_t* where = part.where.grow(n, n + static_cast<size_t>(column1 - column0 + 1));
    for (int tile = row * grid.columns + column0; tile <= row * grid.columns + column1; ++tile) {
      if (frame.state[static_cast<size_t>(tile)] == TileState::finished) continue;
      where[n++] = static_cast<uint32_t>(tile);
      ++part.cursor[static_cast<size_t>(tile)];
    }
  });
  part.n_entries = static_cast<int64_t>(n);
}

void make_part(const Frame& frame, const Splats& splats, Slab& slab, SlabPart& part) {
  const size_t tiles = static_cast<size_t>(frame.grid.tiles());
  std::memset(part.cursor.reserve(tiles), 0, tiles * sizeof(uint32_t));
  uint32_t* first = part.first.reserve(static_cast<size_t>(part.count) + 1);
  const DepthKey* order = part.order.data();
  Record* records = slab.records.data() + part.rank_begin;
  part.n_entries = 0;
  Sixteen sixteen = {};
  for (int64_t i = 0; i < part.count; i += kLanes) {
    const int n = static_cast<int>(std::min<int64_t>(kLanes, part.count - i));
    const int64_t ahead = std::min<int64_t>(i + 2 * kLanes, part.count);
    for (int64_t k = i + kLanes; k < ahead; ++k) prefetch(splats, order[k].splat);
    gather_splats(splats, order + i, n, sixteen);
    derive(sixteen);
    for (int k = 0; k < n; ++k) {
      first[i + k] = static_cast<uint32_t>(part.n_entries);
      const DepthKey& item = order[i + k];
      if (write_record(sixteen, k, splats.colours + 3 * static_cast<int64_t>(item.splat), item.key, records[i + k]))
        note_tiles(frame, records[i + k], part);
      // Places in a slab are 32-bit. A slab holds some hundred entries per tile, far from this limit
      // unless tens of thousands of splats each cover a picture of hundreds of megapixels.
      if (part.n_entries > INT32_MAX)
        throw std::length_error("too many splats cover the whole picture: draw it in parts");
    }
  }
  first[part.count] = static_cast<uint32_t>(part.n_entries);
}

}  // namespace

void make_records(const Frame& frame, const Splats& splats, Slab& slab) {
  slab.records.reserve(static_cast<size_t>(slab.count));
  parallel_for(slab.n_parts, [&](int64_t p) { make_part(frame, splats, slab, *slab.parts[static_cast<size_t>(p)]); });
}

void scatter_entries(const TileGrid& grid, Slab& slab) {
  const size_t tiles = static_cast<size_t>(grid.tiles());
  slab.n_entries = 0;
  for (int p = 0; p < slab.n_parts; ++p) slab.n_entries += static_cast<uint64_t>(slab.parts[static_cast<size_t>(p)]->n_entries);
  if (slab.n_entries > UINT32_MAX) throw std::length_error("too many splats cover the whole picture: draw it in parts");
  slab.entries.reserve(slab.n_entries), slab.touched.reserve(slab.n_entries), slab.visited.reserve(tiles);
  // Within a tile the parts follow each other, as they do in depth.
  uint32_t* tile_begin = slab.tile_begin.reserve(tiles + 1);
  uint32_t total = 0;
  for (size_t tile = 0; tile < tiles; ++tile) {
    tile_begin[tile] = total;
    for (int p = 0; p < slab.n_parts; ++p) total += std::exchange(slab.parts[static_cast<size_t>(p)]->cursor[tile], total);
  }
  tile_begin[tiles] = total;
  parallel_for(slab.n_parts, [&](int64_t p) {
    SlabPart& part = *slab.parts[static_cast<size_t>(p)];
    uint32_t *where = part.where.data(), *cursor = part.cursor.data(), *entries = slab.entries.data();
    const uint32_t* first = part.first.data();
    for (int64_t i = 0; i < part.count; ++i)
      for (uint32_t k = first[i]; k < first[i + 1]; ++k) {
        where[k] = cursor[where[k]]++;
        entries[where[k]] = static_cast<uint32_t>(part.rank_begin + i);
      }
  });
}

}  // namespace vdgs::raster
