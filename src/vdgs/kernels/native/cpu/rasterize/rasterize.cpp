// The phases of rasterize.h, one after the other.
#include "cpu/rasterize/rasterize.h"

#include <limits>

#include "cpu/rasterize/frame.h"

namespace vdgs::raster {
namespace {

void begin_frame(Frame& frame, const Splats& splats, int width, int height, bool with_depth) {
  frame.grid = {width, height, (width + kTileSide - 1) / kTileSide, (height + kTileSide - 1) / kTileSide};
  frame.n_splats = splats.count;
  frame.with_depth = with_depth;
  frame.n_slabs = 0;
  frame.stats = {};
  for (double& s : frame.seconds) s = 0;
  const size_t tiles = static_cast<size_t>(frame.grid.tiles());
  std::memset(static_cast<void*>(frame.state.reserve(tiles)), 0, tiles);
  frame.any_stop.reserve(tiles);
  frame.transmittance.reserve(tiles * kTilePixels);
  frame.stop.reserve(tiles * kTilePixels);
  if (with_depth) frame.median_depth.reserve(tiles * kTilePixels);
}

Slab& add_slab(Frame& frame) {
  const size_t used = static_cast<size_t>(frame.n_slabs++);
  if (frame.slabs.size() == used) frame.slabs.push_back(std::make_unique<Slab>());
  return *frame.slabs[used];
}

// Recounts the unfinished tiles; returns how many there are.
int32_t count_open_tiles(Frame& frame) {
  const size_t columns = static_cast<size_t>(frame.grid.columns), rows = static_cast<size_t>(frame.grid.rows);
  const size_t stride = columns + 1;
  int32_t* table = frame.open_before.reserve((rows + 1) * stride);
  std::memset(table, 0, stride * sizeof(int32_t));
  for (size_t y = 0; y < rows; ++y) {
    int32_t in_row = 0;
    table[(y + 1) * stride] = 0;
    for (size_t x = 0; x < columns; ++x) {
      in_row += frame.state[y * columns + x] != TileState::finished;
      table[(y + 1) * stride + x + 1] = table[y * stride + x + 1] + in_row;
    }
  }
  return table[rows * stride + columns];
}

void count_entries(const Slab& slab, const TileGrid& grid, Statistics& stats) {
  stats.sorted += slab.count;
  stats.entries += static_cast<int64_t>(slab.n_entries);
  for (size_t tile = 0; tile < static_cast<size_t>(grid.tiles()); ++tile) stats.visited += slab.visited[tile];
}

}  // namespace

void forward(Frame& frame, const Splats& splats, const float background[3], int width, int height,
             const Picture& out, bool counting) {
  Stopwatch watch;
  begin_frame(frame, splats, width, height, out.depth != nullptr);
  cull(splats, frame.grid, frame.work, frame.candidates);
  frame.stats.candidates = frame.candidates.count;
  frame.seconds[kCull] = watch.lap();
  const DepthSample sample = sample_depths(frame.candidates);
  DepthRange range{0, -std::numeric_limits<float>::infinity(), 0, 0};
  bool last = false;
  while (!last) {
    Slab& slab = add_slab(frame);
    range = next_slab(sample, frame.grid, range, frame.n_slabs - 1);
    last = range.end == sample.depth.size();
    if (!last) frame.unfinished.reserve(static_cast<size_t>(frame.grid.tiles()));
    select_and_sort(frame, sample, range, slab);
    frame.seconds[kSelect] += watch.lap();
    note_tiles(frame, splats, slab);
    frame.seconds[kBin] += watch.lap();
    scatter_entries(frame.grid, slab);
    frame.seconds[kScatter] += watch.lap();
    forward_tiles(frame, slab, last, background, out, counting);
    if (!last) last = count_open_tiles(frame) == 0;
    frame.seconds[kForward] += watch.lap();
    if (counting) count_entries(slab, frame.grid, frame.stats);
  }
}

void backward(Frame& frame, const float background[3], const PictureGradients& in,
              const SplatGradients& out) {
  const std::lock_guard<std::mutex> lock(frame.mutex);
  Stopwatch watch;
  backward_tiles(frame, background, in, out.count);
  frame.seconds[kBackward] = watch.lap();
  reduce_gradients(frame, out);
  frame.seconds[kReduce] = watch.lap();
}

void shares(Frame& frame, const float* lacking, float* pixels, float* missing) {
  const std::lock_guard<std::mutex> lock(frame.mutex);
  Stopwatch watch;
  share_tiles(frame, lacking);
  frame.seconds[kBackward] = watch.lap();
  reduce_shares(frame, pixels, missing);
  frame.seconds[kReduce] = watch.lap();
}

size_t Frame::bytes() const {
  size_t total =
      work.bytes() + transmittance.bytes() + stop.bytes() + unfinished.bytes() + median_depth.bytes();
  for (const auto& slab : slabs) {
    total += slab->records.bytes() + slab->entries.bytes() + slab->touched.bytes();
    for (const auto& part : slab->parts)
      total += part->splat.bytes() + part->order.bytes() + part->scratch.bytes() + part->first.bytes() +
               part->where.bytes() + part->cursor.bytes();
  }
  return total;
}

}  // namespace vdgs::raster
