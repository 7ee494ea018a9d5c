// Records in depth order, and which splats each tile has to look at.
#include <cmath>
#include <stdexcept>

#include "threads.h"
#include "tile.h"

namespace vdgs::raster {
namespace {

constexpr const char* kTooManyEntries = "too many splats cover the whole picture: draw it in parts";

// Sixteen splats of a part, field by field.
struct alignas(64) Sixteen {
  float x[16], y[16], a[16], b[16], c[16], det[16], opacity[16];
  float ux[16], uy[16], vy[16], log2_opacity[16], best_y[16], best_x[16];
  int32_t column0[16], column1[16], row0[16], row1[16];  // of tiles; none if column0 > column1
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

VDGS_INLINE void derive(Sixteen& s, const TileGrid& grid) {
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
  const TileInterval columns = tile_interval(load(s.x), sqrt(scale * c) + splat(1e-3f), grid.width);
  const TileInterval rows = tile_interval(load(s.y), sqrt(scale * a) + splat(1e-3f), grid.height);
  const M16 drawn = columns.hit & rows.hit & gt(det, splat(0.0f));
  store(s.column0, to_int(select(drawn, columns.first, splat(1.0f))));
  store(s.column1, to_int(zero_unless(drawn, columns.last)));
  store(s.row0, to_int(zero_unless(drawn, rows.first)));
  store(s.row1, to_int(zero_unless(drawn, rows.last)));
}

// The key is a bijection of the depth: no need to fetch it again.
float depth_of_key(uint32_t key) {
  const uint32_t u = key ^ (key >> 31 ? 0x80000000u : 0xffffffffu);
  float depth;
  std::memcpy(&depth, &u, 4);
  return depth;
}

void write_record(const Sixteen& s, int k, const float* colour, uint32_t key, Record& r) {
  r = Record{s.x[k], s.y[k], s.ux[k], s.uy[k], s.vy[k], s.log2_opacity[k], {colour[0], colour[1], colour[2]},
             depth_of_key(key), s.best_y[k], s.best_x[k], s.opacity[k], {}};
}

bool is_finite(const float* colour) {
  return std::fabs(colour[0]) + std::fabs(colour[1]) + std::fabs(colour[2]) < __builtin_inff();
}

// Adds the tiles that the ellipse alpha >= 1/255 reaches to `where`, sixteen tested at a time; returns
// how many `where` holds then.
size_t note_tiles(const Record& r, const Sixteen& s, int k, int columns, I16 tile_of_lane, size_t n,
                  Buffer<uint32_t>& where) {
  const F16 x = load(kLaneX) * splat(static_cast<float>(kTileSide)) + splat(0.5f - r.mean_x);
  const F16 y = load(kLaneY) * splat(static_cast<float>(kTileSide)) + splat(0.5f - r.mean_y);
  for (int row = s.row0[k]; row <= s.row1[k]; row += 4)
    for (int column = s.column0[k]; column <= s.column1[k]; column += 4) {
      const F16 dx = x + splat(static_cast<float>(column * kTileSide));
      const F16 dy = y + splat(static_cast<float>(row * kTileSide));
      const unsigned in_columns = 0x1111u * ((1u << std::min(4, s.column1[k] - column + 1)) - 1u);
      const unsigned in_rows = (1u << 4 * std::min(4, s.row1[k] - row + 1)) - 1u;
      const M16 reached = squares_in_reach(r, dx, dy, kTileSide - 1) & mask_of_bits(in_columns & in_rows);
      int32_t* end = reinterpret_cast<int32_t*>(where.grow(n, n + kLanes) + n);
      compress_store(end, reached, tile_of_lane + splat(row * columns + column));
      n += static_cast<size_t>(__builtin_popcount(bits(reached)));
    }
  return n;
}

// Takes the finished tiles out of where[begin, end); returns the new end.
size_t drop_finished(const Frame& frame, uint32_t* where, size_t begin, size_t end) {
  size_t kept = begin;
  for (size_t i = begin; i < end; ++i) {
    where[kept] = where[i];
    kept += frame.state[where[i]] != TileState::finished;
  }
  return kept;
}

void make_part(const Frame& frame, const Splats& splats, Slab& slab, SlabPart& part) {
  uint32_t* first = part.first.reserve(static_cast<size_t>(part.count) + 1);
  const DepthKey* order = part.order.data();
  Record* records = slab.records.data() + part.rank_begin;
  alignas(64) int32_t tile_of_lane[16];
  for (int i = 0; i < 16; ++i) tile_of_lane[i] = (i >> 2) * frame.grid.columns + (i & 3);
  size_t n_entries = 0;
  Sixteen sixteen = {};
  for (int64_t i = 0; i < part.count; i += kLanes) {
    const int n = static_cast<int>(std::min<int64_t>(kLanes, part.count - i));
    const int64_t ahead = std::min<int64_t>(i + 2 * kLanes, part.count);
    for (int64_t k = i + kLanes; k < ahead; ++k) prefetch(splats, order[k].splat);
    gather_splats(splats, order + i, n, sixteen);
    derive(sixteen, frame.grid);
    for (int k = 0; k < n; ++k) {
      const float* colour = splats.colours + 3 * static_cast<int64_t>(order[i + k].splat);
      Record& record = records[i + k];
      write_record(sixteen, k, colour, order[i + k].key, record);
      const size_t begin = n_entries;
      first[i + k] = static_cast<uint32_t>(begin);
      if (!is_finite(colour)) continue;
      n_entries = note_tiles(record, sixteen, k, frame.grid.columns, load(tile_of_lane), begin, part.where);
      if (frame.n_slabs > 1) n_entries = drop_finished(frame, part.where.data(), begin, n_entries);
    }
    // Places in a slab are 32-bit. A slab holds some hundred entries per tile, far from this limit
    // unless thousands of splats each cover a picture of hundreds of megapixels.
    if (n_entries > INT32_MAX) throw std::length_error(kTooManyEntries);
  }
  first[part.count] = static_cast<uint32_t>(n_entries);
  part.n_entries = static_cast<int64_t>(n_entries);
}

void count_per_tile(const TileGrid& grid, SlabPart& part) {
  const size_t tiles = static_cast<size_t>(grid.tiles());
  uint32_t* cursor = part.cursor.reserve(tiles);
  std::memset(cursor, 0, tiles * sizeof(uint32_t));
  for (size_t i = 0; i < static_cast<size_t>(part.n_entries); ++i) ++cursor[part.where[i]];
}

}  // namespace

void make_records(const Frame& frame, const Splats& splats, Slab& slab) {
  slab.records.reserve(static_cast<size_t>(slab.count));
  parallel_for(slab.n_parts, [&](int64_t p) {
    SlabPart& part = *slab.parts[static_cast<size_t>(p)];
    make_part(frame, splats, slab, part);
    count_per_tile(frame.grid, part);
  });
}

void scatter_entries(const TileGrid& grid, Slab& slab) {
  const size_t tiles = static_cast<size_t>(grid.tiles());
  slab.n_entries = 0;
  for (int p = 0; p < slab.n_parts; ++p) slab.n_entries += static_cast<uint64_t>(slab.parts[static_cast<size_t>(p)]->n_entries);
  if (slab.n_entries > UINT32_MAX) throw std::length_error(kTooManyEntries);
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
