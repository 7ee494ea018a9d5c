// Which splats can reach a pixel center, and how many tiles their boxes hold.
#include "threads.h"
#include "cpu/rasterize/tile.h"

namespace vdgs::raster {
namespace {

constexpr float kInfinity = __builtin_inff();

VDGS_INLINE I16 pack(F16 first, F16 last) { return to_int(first) | shift_left<16>(to_int(last)); }

// Adds the candidates among sixteen splats from index `i` on; returns how many there were.
VDGS_INLINE int cull_sixteen(F16 x, F16 y, F16 a, F16 b, F16 c, F16 opacity, F16 depth, M16 valid, int64_t i,
                             const TileGrid& grid, Candidates& out, int64_t at, F16& tiles) {
  // The determinant cancels for thin splats. Judged and shrunk by its rounding error, it makes the
  // box a little larger than need be; make_records decides with the exact one.
  const F16 ac = a * c, rounding = ac * splat(4e-7f);
  const F16 det = fnma(b, b, ac);
  const F16 infinity = splat(kInfinity);
  const M16 finite = lt(abs(x) + abs(y), infinity) & lt(abs(depth), infinity) & lt(opacity, infinity) &
                     lt(ac + b * b, infinity);
  valid = valid & finite & gt(a, splat(0.0f)) & gt(c, splat(0.0f)) & gt(det + rounding, splat(0.0f)) &
          ge(opacity, splat(kAlphaMin));
  if (none(valid)) return 0;

  const F16 certain = det - rounding;
  const F16 exponent = log2(select(valid, opacity, splat(1.0f))) - splat(kLog2AlphaMin - kExponentSlack);
  const F16 scale = exponent * splat(1.0f / kHalfLog2E) / certain;
  const M16 bounded = gt(certain, splat(0.0f));
  const F16 reach_x = select(bounded, sqrt(scale * c), splat(1e9f)) + splat(1e-3f);
  const F16 reach_y = select(bounded, sqrt(scale * a), splat(1e9f)) + splat(1e-3f);
  const TileInterval columns = tile_interval(x, reach_x, grid.width);
  const TileInterval rows = tile_interval(y, reach_y, grid.height);
  valid = valid & columns.hit & rows.hit;

  const F16 one = splat(1.0f);
  tiles = tiles + zero_unless(valid, (columns.last - columns.first + one) * (rows.last - rows.first + one));
  alignas(64) static constexpr int32_t kLaneIndex[16] = {0, 1, 2,  3,  4,  5,  6,  7,
                                                         8, 9, 10, 11, 12, 13, 14, 15};
  compress_store(out.depth + at, valid, depth);
  compress_store(out.splat + at, valid, splat(static_cast<int32_t>(i)) + load(kLaneIndex));
  compress_store(out.columns + at, valid, pack(columns.first, columns.last));
  compress_store(out.rows + at, valid, pack(rows.first, rows.last));
  return __builtin_popcount(bits(valid));
}

// The last, incomplete group is copied to where sixteen may be read.
struct Tail {
  alignas(64) float means[32] = {}, conics[48] = {}, opacities[16] = {}, depths[16] = {};
};

void cull_chunk(const Splats& s, const TileGrid& grid, int64_t chunk, Candidates& out) {
  const int64_t begin = chunk * Candidates::kChunk, end = std::min(s.count, begin + Candidates::kChunk);
  int64_t at = begin;
  F16 tiles = splat(0.0f);
  Tail tail;
  for (int64_t i = begin; i < end; i += kLanes) {
    const int n = static_cast<int>(std::min<int64_t>(kLanes, end - i));
    const float *means = s.means + 2 * i, *conics = s.conics + 3 * i;
    const float *opacities = s.opacities + i, *depths = s.depths + i;
    if (n < kLanes) {
      const size_t count = static_cast<size_t>(n);
      means = static_cast<float*>(std::memcpy(tail.means, means, count * 8));
      conics = static_cast<float*>(std::memcpy(tail.conics, conics, count * 12));
      opacities = static_cast<float*>(std::memcpy(tail.opacities, opacities, count * 4));
      depths = static_cast<float*>(std::memcpy(tail.depths, depths, count * 4));
    }
    F16 x, y, a, b, c;
    load2(means, x, y);
    load3(conics, a, b, c);
    at +=
        cull_sixteen(x, y, a, b, c, loadu(opacities), loadu(depths), first_lanes(n), i, grid, out, at, tiles);
  }
  out.chunk_count[chunk] = at - begin;
  out.chunk_tiles[chunk] = hsum(tiles);
}

}  // namespace

void cull(const Splats& splats, const TileGrid& grid, Buffer<float>& work, Candidates& out) {
  const int64_t chunks = (splats.count + Candidates::kChunk - 1) / Candidates::kChunk;
  const size_t room = static_cast<size_t>(splats.count);
  out.depth = work.reserve(4 * room);
  out.splat = reinterpret_cast<int32_t*>(out.depth + room);
  out.columns = out.splat + room, out.rows = out.columns + room;
  out.chunk_count.assign(static_cast<size_t>(chunks), 0);
  out.chunk_tiles.assign(static_cast<size_t>(chunks), 0.0);
  parallel_for(chunks, [&](int64_t chunk) { cull_chunk(splats, grid, chunk, out); });
  out.count = 0, out.tiles = 0;
  for (int64_t count : out.chunk_count) out.count += count;
  for (double tiles : out.chunk_tiles) out.tiles += tiles;
}

}  // namespace vdgs::raster
