// What each splat makes of a picture: the sum of its weights over the pixels, and that of weight times what
// a picture lacks. Derivatives by colors alone: front to back, four sums per entry in place of ten.
#include "threads.h"
#include "cpu/rasterize/tile.h"

namespace vdgs::raster {
namespace {

struct alignas(64) TileShares {
  float transmittance[kTilePixels];  // before the entry at hand
  float lacking[3][kTilePixels];
  float stop[kTilePixels];
};

void begin_tile(const Frame& frame, int tile, const float* lacking, TileShares& shares) {
  std::memset(shares.lacking, 0, sizeof shares.lacking);
  for (int i = 0; i < kTilePixels; i += kLanes) store(shares.transmittance + i, splat(1.0f));
  for_each_pixel_row(frame.grid, tile, [&](int n, int place, int64_t pixel) {
    F16 r, g, b;
    read_row3(lacking + 3 * pixel, n, r, g, b);
    store_quads(shares.lacking[0] + place, kLanes, r);
    store_quads(shares.lacking[1] + place, kLanes, g);
    store_quads(shares.lacking[2] + place, kLanes, b);
  });
  const size_t first = static_cast<size_t>(tile) * kTilePixels;
  if (frame.any_stop[tile]) std::memcpy(shares.stop, frame.stop.data() + first, sizeof shares.stop);
}

// One entry: all blocks that it touched.
template <bool any_stop>
VDGS_INLINE void entry_shares(const Record& r, const BlockOrigins& origins, unsigned touched, float order,
                              TileShares& shares, float* out) {
  Falloff falloff;
  make_falloff(r, origins.x - splat(r.mean_x), origins.y - splat(r.mean_y), falloff);
  F16 all = splat(0.0f), red = all, green = all, blue = all;
  for (; touched; touched &= touched - 1) {
    const int block = __builtin_ctz(touched), at = block * kLanes;
    const F16 exponent = exponent_in_block(falloff, block, r.log2_opacity).value;
    M16 reached = reaches(exponent);
    if (any_stop) reached = reached & lt(splat(order), load(shares.stop + at));
    const F16 alpha = zero_unless(reached, min(exp2_bounded(exponent), splat(kAlphaMax)));
    const F16 before = load(shares.transmittance + at);
    const F16 weight = alpha * before;
    store(shares.transmittance + at, before - weight);
    all = all + weight;
    red = fma(weight, load(shares.lacking[0] + at), red);
    green = fma(weight, load(shares.lacking[1] + at), green);
    blue = fma(weight, load(shares.lacking[2] + at), blue);
  }
  hsum4(out, all, red, green, blue);
}

template <bool any_stop>
void slab_shares(const Frame& frame, Slab& slab, int tile, uint32_t& seen, TileShares& shares) {
  const BlockOrigins origins(frame.grid, tile);
  const size_t begin = slab.tile_begin[tile];
  const uint32_t n = slab.visited[tile];
  const uint32_t* entries = slab.entries.data() + begin;
  const uint16_t* touched = slab.touched.data() + begin;
  for (uint32_t i = 0; i < n; ++i) {
    if (i + 12 < n) __builtin_prefetch(slab.records.data() + entries[i + 12]);
    if (!touched[i]) continue;
    entry_shares<any_stop>(slab.records[entries[i]], origins, touched[i], order_of(seen + i), shares,
                           slab.sums + (begin + i) * kShares);
  }
  seen += n;
}

}  // namespace

void share_tiles(Frame& frame, const float* lacking) {
  constexpr int kTilesPerTask = 4;
  const int tiles = frame.grid.tiles();
  room_for_sums(frame, kShares);
  parallel_for((tiles + kTilesPerTask - 1) / kTilesPerTask, [&](int64_t task) {
    const int begin = static_cast<int>(task) * kTilesPerTask;
    for (int tile = begin; tile < std::min(tiles, begin + kTilesPerTask); ++tile) {
      TileShares shares;
      begin_tile(frame, tile, lacking, shares);
      const auto through = frame.any_stop[tile] ? slab_shares<true> : slab_shares<false>;
      uint32_t seen = 0;
      for (int s = 0; s < frame.n_slabs; ++s) through(frame, *frame.slabs[s], tile, seen, shares);
    }
  });
}

}  // namespace vdgs::raster
