// Which splats each tile has to look at.
#include <stdexcept>

#include "threads.h"
#include "cpu/rasterize/tile.h"

namespace vdgs::raster {
namespace {

constexpr const char* kTooManyEntries = "too many splats cover the whole picture: draw it in parts";

// Adds the tiles that the ellipse alpha >= 1/255 reaches to `where`, sixteen tested at a time; returns
// how many `where` holds then.
size_t note_splat(const Record& r, int grid_columns, I16 tile_of_lane, size_t n, Buffer<uint32_t>& where) {
  const F16 x = load(kLaneX) * splat(static_cast<float>(kTileSide)) + splat(0.5f - r.mean_x);
  const F16 y = load(kLaneY) * splat(static_cast<float>(kTileSide)) + splat(0.5f - r.mean_y);
  const int last_column = static_cast<int>(r.columns >> 16), last_row = static_cast<int>(r.rows >> 16);
  for (int row = r.rows & 0xffff; row <= last_row; row += 4)
    for (int column = r.columns & 0xffff; column <= last_column; column += 4) {
      const F16 dx = x + splat(static_cast<float>(column * kTileSide));
      const F16 dy = y + splat(static_cast<float>(row * kTileSide));
      const unsigned in_columns = 0x1111u * ((1u << std::min(4, last_column - column + 1)) - 1u);
      const unsigned in_rows = (1u << 4 * std::min(4, last_row - row + 1)) - 1u;
      const M16 reached = squares_in_reach(r, dx, dy, kTileSide - 1) & mask_of_bits(in_columns & in_rows);
      int32_t* end = reinterpret_cast<int32_t*>(where.grow(n, n + kLanes) + n);
      compress_store(end, reached, tile_of_lane + splat(row * grid_columns + column));
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

// Notes the tiles of a part's splats, front to back.
void note_part(const Frame& frame, const Record* records, SlabPart& part) {
  uint32_t* first = part.first.reserve(static_cast<size_t>(part.count) + 1);
  const DepthKey* order = part.order.data();
  alignas(64) int32_t tile_of_lane[16];
  for (int i = 0; i < 16; ++i) tile_of_lane[i] = (i >> 2) * frame.grid.columns + (i & 3);
  constexpr int64_t kAhead = 16;
  size_t n = 0;
  for (int64_t i = 0; i < part.count; ++i) {
    if (i + kAhead < part.count) __builtin_prefetch(records + order[i + kAhead].pick);
    const Record& record = records[order[i].pick];
    first[i] = static_cast<uint32_t>(n);
    if (record.columns == kNoTiles) continue;
    const size_t begin = n;
    n = note_splat(record, frame.grid.columns, load(tile_of_lane), n, part.where);
    if (frame.n_slabs > 1) n = drop_finished(frame, part.where.data(), begin, n);
    // Places in a slab are 32-bit. A slab holds some hundred entries per tile, far from this limit
    // unless thousands of splats each cover a picture of hundreds of megapixels.
    if (n > INT32_MAX) throw std::length_error(kTooManyEntries);
  }
  first[part.count] = static_cast<uint32_t>(n);
  part.n_entries = static_cast<int64_t>(n);
}

void count_per_tile(const TileGrid& grid, SlabPart& part) {
  const size_t tiles = static_cast<size_t>(grid.tiles());
  uint32_t* cursor = part.cursor.reserve(tiles);
  std::memset(cursor, 0, tiles * sizeof(uint32_t));
  for (size_t i = 0; i < static_cast<size_t>(part.n_entries); ++i) ++cursor[part.where[i]];
}

}  // namespace

void note_tiles(const Frame& frame, const Splats& splats, Slab& slab) {
  slab.records.reserve(static_cast<size_t>(slab.count));
  parallel_for(slab.n_parts, [&](int64_t p) {
    SlabPart& part = *slab.parts[p];
    Record* records = slab.records.data() + part.begin;
    make_records(splats, frame.grid, part, records);
    note_part(frame, records, part);
    count_per_tile(frame.grid, part);
  });
}

void scatter_entries(const TileGrid& grid, Slab& slab) {
  const size_t tiles = static_cast<size_t>(grid.tiles());
  slab.n_entries = 0;
  for (int p = 0; p < slab.n_parts; ++p) slab.n_entries += static_cast<uint64_t>(slab.parts[p]->n_entries);
  if (slab.n_entries > UINT32_MAX) throw std::length_error(kTooManyEntries);
  slab.entries.reserve(slab.n_entries), slab.touched.reserve(slab.n_entries), slab.visited.reserve(tiles);
  // Within a tile the parts follow each other, as they do in depth.
  uint32_t* tile_begin = slab.tile_begin.reserve(tiles + 1);
  uint32_t total = 0;
  for (size_t tile = 0; tile < tiles; ++tile) {
    tile_begin[tile] = total;
    for (int p = 0; p < slab.n_parts; ++p) {
      const uint32_t count = std::exchange(slab.parts[p]->cursor[tile], total);
      total += count;
    }
  }
  tile_begin[tiles] = total;
  parallel_for(slab.n_parts, [&](int64_t p) {
    SlabPart& part = *slab.parts[p];
    uint32_t *where = part.where.data(), *cursor = part.cursor.data(), *entries = slab.entries.data();
    const uint32_t* first = part.first.data();
    for (int64_t i = 0; i < part.count; ++i) {
      const uint32_t record = static_cast<uint32_t>(part.begin) + part.order[i].pick;
      for (uint32_t k = first[i]; k < first[i + 1]; ++k) {
        where[k] = cursor[where[k]]++;
        entries[where[k]] = record;
      }
    }
  });
}

}  // namespace vdgs::raster
