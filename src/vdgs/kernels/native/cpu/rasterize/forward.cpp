// Draws the entries of a slab into its tiles, front to back.
//
// Entries are taken in batches of 64: first it is worked out which blocks each one reaches, then every
// block runs through its own entries of the batch with its pixels in registers. A block whose pixels
// are all finished leaves the tile.
#include <atomic>

#include "threads.h"
#include "cpu/rasterize/tile.h"

namespace vdgs::raster {
namespace {

constexpr int kBatch = 64;

struct alignas(64) Batch {
  Falloff falloff[kBatch];
  struct {
    float color[3], depth;
  } paint[kBatch];
  float log2_opacity[kBatch];
  alignas(64) uint16_t in_reach[kBatch];
  alignas(64) uint16_t touched[kBatch];
};

void prepare_batch(const Record* records, const uint32_t* entries, int n, const BlockOrigins& origins,
                   Batch& batch) {
  for (int j = 0; j < n; ++j) {
    const Record& r = records[entries[j]];
    const F16 dx = origins.x - splat(r.mean_x), dy = origins.y - splat(r.mean_y);
    batch.in_reach[j] = static_cast<uint16_t>(bits(squares_in_reach(r, dx, dy, 3.0f)));
    make_falloff(r, dx, dy, batch.falloff[j]);
    batch.paint[j] = {{r.color[0], r.color[1], r.color[2]}, r.depth};
    batch.log2_opacity[j] = r.log2_opacity;
  }
  for (int j = n; j < kBatch; ++j) batch.in_reach[j] = 0;
  std::memset(batch.touched, 0, sizeof batch.touched);
}

// Blends the chosen entries of a batch into one block. Returns those that contributed. `median_depth`
// is that of the tile (not looked at without depth).
template <bool with_depth, bool counting>
VDGS_INLINE uint64_t blend_block(const Batch& batch, uint64_t chosen, int block, uint32_t first_index,
                                 TilePixels& px, float* median_depth, int64_t& pairs) {
  const int at = block * kTileBlocks;
  F16 t = load(px.transmittance + at);
  F16 c0 = load(px.color[0] + at), c1 = load(px.color[1] + at), c2 = load(px.color[2] + at);
  F16 depth = with_depth ? load(px.depth + at) : splat(0.0f);
  M16 live = mask_of_bits(px.live[block]);
  uint64_t touched = chosen;
  for (; chosen; chosen &= chosen - 1) {
    const int j = __builtin_ctzll(chosen);
    const F16 exponent = exponent_in_block(batch.falloff[j], block, batch.log2_opacity[j]).value;
    const M16 reached = reaches(exponent) & live;
    F16 alpha = zero_unless(reached, min(exp2_bounded(exponent), splat(kAlphaMax)));
    F16 t_next = fnma(alpha, t, t);
    touched ^= static_cast<uint64_t>(none(reached)) << j;  // no branch: it would be hard to predict
    const M16 finishing = lt(t_next, splat(kTransmittanceMin));
    if (__builtin_expect(any(finishing), 0)) {
      // These pixels are finished before this entry: it does not contribute to them.
      live = andnot(finishing, live);
      alpha = zero_unless(live, alpha);
      t_next = fnma(alpha, t, t);
      const F16 stop = splat(order_of(first_index + static_cast<uint32_t>(j)));
      store(px.stop + at, select(finishing, stop, load(px.stop + at)));
      px.any_stop = true;
      if (none(reached & live)) touched &= ~(uint64_t{1} << j);
      if (none(live)) {
        touched &= (uint64_t{2} << j) - 1;  // also right for j = 63
        chosen = 0;
      }
    }
    const F16 weight = alpha * t;
    if (with_depth) {
      const F16 half = splat(kMedianTransmittance);
      const M16 crossing = ge(t, half) & lt(t_next, half);
      if (__builtin_expect(any(crossing), 0)) {  // once for each pixel at most
        float* const median = median_depth + at;
        store(median, select(crossing, splat(batch.paint[j].depth), load(median)));
      }
    }
    t = t_next;
    c0 = fma(weight, splat(batch.paint[j].color[0]), c0);
    c1 = fma(weight, splat(batch.paint[j].color[1]), c1);
    c2 = fma(weight, splat(batch.paint[j].color[2]), c2);
    if (with_depth) depth = fma(weight, splat(batch.paint[j].depth), depth);
    if (counting) pairs += __builtin_popcount(bits(reached & live));
  }
  store(px.transmittance + at, t);
  store(px.color[0] + at, c0), store(px.color[1] + at, c1), store(px.color[2] + at, c2);
  if (with_depth) store(px.depth + at, depth);
  px.live[block] = static_cast<uint16_t>(bits(live));
  return touched;
}

unsigned live_blocks(const TilePixels& px) {
  unsigned blocks = 0;
  for (int b = 0; b < kTileBlocks; ++b) blocks |= (px.live[b] ? 1u : 0u) << b;
  return blocks;
}

// Draws entries until they end or all pixels are finished. Returns how many were looked at.
template <bool with_depth, bool counting>
uint32_t blend_entries(const Frame& frame, Slab& slab, int tile, TilePixels& px, float* median_depth,
                       int64_t& pairs) {
  const uint32_t begin = slab.tile_begin[tile], end = slab.tile_begin[tile + 1];
  const BlockOrigins origins(frame.grid, tile);
  const Record* records = slab.records.data();
  const uint32_t* entries = slab.entries.data();
  for (uint32_t k = begin; k < std::min(end, begin + kBatch); ++k) __builtin_prefetch(records + entries[k]);
  unsigned live = live_blocks(px);
  Batch batch;
  uint32_t i = begin;
  for (; i < end && live; i += std::min<uint32_t>(kBatch, end - i)) {
    const int n = static_cast<int>(std::min<uint32_t>(kBatch, end - i));
    prepare_batch(records, entries + i, n, origins, batch);
    uint32_t prefetched = i + static_cast<uint32_t>(n);
    const uint32_t prefetch_end = std::min(end, prefetched + kBatch);
    for (unsigned blocks = live; blocks; blocks &= blocks - 1) {
      // The records of the next batch arrive while this one is blended, a few per block: memory
      // cannot fetch all of them at once.
      for (int k = 0; k < kBatch / kTileBlocks && prefetched < prefetch_end; ++k)
        __builtin_prefetch(records + entries[prefetched++]);
      const int block = __builtin_ctz(blocks);
      const uint64_t chosen = bit_column(batch.in_reach, block);
      if (!chosen) continue;
      const uint64_t touched = blend_block<with_depth, counting>(batch, chosen, block, px.seen + (i - begin),
                                                                 px, median_depth, pairs);
      set_bit_column(batch.touched, block, touched);
      if (!px.live[block]) live &= ~(1u << block);
    }
    std::memcpy(slab.touched.data() + i, batch.touched, static_cast<size_t>(n) * sizeof(uint16_t));
  }
  std::memset(slab.touched.data() + i, 0, (end - i) * sizeof(uint16_t));
  px.seen += i - begin;
  return i - begin;
}

void clear_pixels(const TileGrid& grid, int tile, TilePixels& px) {
  const F16 zero = splat(0.0f);
  for (int i = 0; i < kTilePixels; i += kLanes) {
    store(px.transmittance + i, splat(1.0f));
    store(px.color[0] + i, zero), store(px.color[1] + i, zero), store(px.color[2] + i, zero);
    store(px.depth + i, zero);
    store(px.stop + i, splat(kNever));
  }
  px.seen = 0;
  px.any_stop = false;
  std::memset(px.live, 0xff, sizeof px.live);
  if (is_whole(grid, tile)) return;
  // Pixels beyond the image are finished before the first entry.
  px.any_stop = true;
  for (int b = 0; b < kTileBlocks; ++b) px.live[b] = 0;
  for (int i = 0; i < kTilePixels; ++i) px.stop[i] = 0.0f;
  for_each_pixel_row(grid, tile, [&](int n, int place, int64_t) {
    for (int x = 0; x < n; ++x) {
      const int at = place + (x >> 2) * kLanes + (x & 3);
      px.stop[at] = kNever;
      px.live[at / kLanes] = static_cast<uint16_t>(px.live[at / kLanes] | 1u << (at % kLanes));
    }
  });
}

// The picture, and what the backward pass wants of the pixels.
void finish_tile(Frame& frame, int tile, const TilePixels& px, const float* median_depth,
                 const float background[3], const Picture& out) {
  const F16 b0 = splat(background[0]), b1 = splat(background[1]), b2 = splat(background[2]);
  for_each_pixel_row(frame.grid, tile, [&](int n, int place, int64_t pixel) {
    const F16 t = load_quads(px.transmittance + place, kLanes);
    write_row(out.alpha + pixel, n, splat(1.0f) - t);
    write_row3(out.image + 3 * pixel, n, fma(t, b0, load_quads(px.color[0] + place, kLanes)),
               fma(t, b1, load_quads(px.color[1] + place, kLanes)),
               fma(t, b2, load_quads(px.color[2] + place, kLanes)));
    if (!out.depth) return;
    write_row(out.depth + pixel, n, load_quads(px.depth + place, kLanes));
    write_row(out.median_depth + pixel, n, load_quads(median_depth + place, kLanes));
  });
  const size_t first = static_cast<size_t>(tile) * kTilePixels;
  std::memcpy(frame.transmittance.data() + first, px.transmittance, sizeof px.transmittance);
  frame.any_stop[tile] = px.any_stop;
  if (px.any_stop) std::memcpy(frame.stop.data() + first, px.stop, sizeof px.stop);
}

template <bool with_depth, bool counting>
void draw_tile(Frame& frame, Slab& slab, int tile, bool last, const float background[3], const Picture& out,
               int64_t& pairs) {
  const size_t index = static_cast<size_t>(tile);
  TileState& state = frame.state[index];
  slab.visited[index] = 0;
  if (state == TileState::finished) return;
  TilePixels on_stack;
  // Between slabs the pixels wait in memory; a tile that needs one slab only never leaves the cache.
  TilePixels& px = state == TileState::open ? frame.unfinished[index] : on_stack;
  float* const median_depth = with_depth ? frame.median_depth.data() + index * kTilePixels : nullptr;
  if (state == TileState::fresh) {
    clear_pixels(frame.grid, tile, px);
    if (with_depth) std::memset(median_depth, 0, kTilePixels * sizeof(float));
  }
  slab.visited[index] = blend_entries<with_depth, counting>(frame, slab, tile, px, median_depth, pairs);
  if (last || live_blocks(px) == 0) {
    finish_tile(frame, tile, px, median_depth, background, out);
    state = TileState::finished;
  } else if (state == TileState::fresh) {
    frame.unfinished[index] = px;
    state = TileState::open;
  }
}

template <bool with_depth, bool counting>
void draw_tiles(Frame& frame, Slab& slab, bool last, const float background[3], const Picture& out) {
  constexpr int kTilesPerTask = 4;
  const int tiles = frame.grid.tiles();
  std::atomic<int64_t> pairs{0};
  parallel_for((tiles + kTilesPerTask - 1) / kTilesPerTask, [&](int64_t task) {
    const int begin = static_cast<int>(task) * kTilesPerTask;
    int64_t task_pairs = 0;
    for (int tile = begin; tile < std::min(tiles, begin + kTilesPerTask); ++tile)
      draw_tile<with_depth, counting>(frame, slab, tile, last, background, out, task_pairs);
    if (counting) pairs += task_pairs;
  });
  frame.stats.pairs += pairs;
}

}  // namespace

void forward_tiles(Frame& frame, Slab& slab, bool last, const float background[3], const Picture& out,
                   bool counting) {
  const auto draw = frame.with_depth ? (counting ? draw_tiles<true, true> : draw_tiles<true, false>)
                                     : (counting ? draw_tiles<false, true> : draw_tiles<false, false>);
  draw(frame, slab, last, background, out);
}

}  // namespace vdgs::raster
