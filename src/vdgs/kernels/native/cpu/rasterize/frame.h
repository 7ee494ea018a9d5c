// What lives between the phases of the rasterizer, and between its forward and backward pass.
#pragma once

#include <chrono>
#include <memory>
#include <mutex>
#include <vector>

#include "cpu/buffer.h"
#include "image_formation.h"
#include "cpu/rasterize/rasterize.h"

namespace vdgs::raster {

// exp(-q/2) = 2^(-kHalfLog2E q)
constexpr float kHalfLog2E = 0.72134752044448170f;

constexpr int kTileSide = 16;
constexpr int kTilePixels = kTileSide * kTileSide;
constexpr int kTileBlocks = 16;  // 4 x 4 pixels each

// Contributing exponents are allowed this much rounding before a block or tile is ruled out.
constexpr float kExponentSlack = 2e-4f;

// A splat as the tiles read it: one cache line. With dx, dy from the mean to a pixel center,
//     u = ux dx + uy dy,   v = vy dy,   log2 alpha = log2_opacity - u^2 - v^2:
// the Cholesky factor of the conic, which keeps its precision for splats seen edge-on.
struct alignas(64) Record {
  float mean_x, mean_y;
  float ux, uy, vy;
  float log2_opacity;
  float color[3];
  float depth;
  float best_y_per_x;  // -b/c: on a vertical line at dx the splat is strongest at dy = this * dx
  float best_x_per_y;  // -b/a
  float opacity;
  uint32_t columns, rows;  // tiles of the splat's box: first | last << 16; none if columns is kNoTiles
  uint32_t splat;          // row of the input
};
constexpr uint32_t kNoTiles = 1;  // first 1, last 0
static_assert(sizeof(Record) == 64);

struct TileGrid {
  int width = 0, height = 0, columns = 0, rows = 0;
  int tiles() const { return columns * rows; }
};

// Culled splats: those that reach a pixel, by chunks of the input (chunk c begins at c * kChunk).
struct Candidates {
  static constexpr int64_t kChunk = 8192;
  float* depth = nullptr;  // these four are in Frame::work, and gone once the backward pass begins
  int32_t* splat = nullptr;
  int32_t *columns = nullptr, *rows = nullptr;  // of tiles: first | last << 16
  std::vector<int64_t> chunk_count;
  std::vector<double> chunk_tiles;  // how many tiles their boxes hold, summed
  int64_t count = 0;
  double tiles = 0;
};

struct DepthKey {
  uint32_t key;  // orders as the depth does
  uint32_t pick;
};

// A contiguous part of a slab's range of depth, worked on by one thread until its tiles are binned.
//
// Its splats ("picks") are numbered in the order of the input. All that touches the rows of the input,
// or of its gradients, goes through them in that order: memory is far slower the other way.
struct SlabPart {
  int64_t begin = 0, count = 0;  // of its picks among those of the slab
  int64_t n_entries = 0;
  Buffer<int32_t> splat;            // [count] of each pick, ascending
  Buffer<DepthKey> order, scratch;  // [count] the picks by depth; room to sort, and for the backward pass
  Buffer<uint32_t> first;           // [count + 1] where the entries of a pick begin in `where`, by depth
  Buffer<uint32_t> where;           // [n_entries] by depth: first the tile, then the entry's place in it
  Buffer<uint32_t> cursor;          // [tiles] where this part's next entry of a tile goes
};

// A range of depth: its splats, and for every tile the entries, front to back, that reach it.
struct Slab {
  int64_t count = 0;
  uint64_t n_entries = 0;
  std::vector<std::unique_ptr<SlabPart>> parts;
  int n_parts = 0;
  Buffer<Record> records;       // [count] pick by pick
  Buffer<uint32_t> tile_begin;  // [tiles + 1]
  Buffer<uint32_t> entries;     // [n_entries] which record
  Buffer<uint16_t> touched;     // [n_entries] blocks in which the entry contributed
  Buffer<uint32_t> visited;     // [tiles] entries looked at before the tile was finished
  float* sums = nullptr;        // [n_entries, n_sums or kShares] of a way back, where touched; in Frame::work
};

// The pixels of one tile, block by block.
struct alignas(64) TilePixels {
  float transmittance[kTilePixels];
  float color[3][kTilePixels];
  float depth[kTilePixels];
  float stop[kTilePixels];     // order_of() of the entry that finished the pixel
  uint16_t live[kTileBlocks];  // pixels that are not finished
  uint32_t seen;               // entries in the slabs before
  bool any_stop;               // whether `stop` says anything
};

enum class TileState : uint8_t { fresh, open, finished };

struct Statistics {
  int64_t candidates = 0, sorted = 0, entries = 0, visited = 0, pairs = 0;
};

struct Frame {
  std::mutex mutex;  // one backward pass at a time
  TileGrid grid;
  int64_t n_splats = 0;
  bool with_depth = false;
  Candidates candidates;
  Buffer<float> work;  // what only the forward pass needs, then what only the backward pass needs
  std::vector<std::unique_ptr<Slab>> slabs;  // all ever made, reused; the first n_slabs are in use
  int n_slabs = 0;
  Buffer<TileState> state;        // [tiles]
  Buffer<uint8_t> any_stop;       // [tiles]
  Buffer<float> transmittance;    // [tiles, 256] at the end, block by block
  Buffer<float> stop;             // [tiles, 256] where any_stop
  Buffer<TilePixels> unfinished;  // [tiles] pixels between slabs, if there are several
  Buffer<float> median_depth;     // [tiles, 256] block by block, if with_depth
  Buffer<int32_t> open_before;    // [rows + 1, columns + 1] summed-area table of unfinished tiles
  Buffer<float> background_sums;  // [tiles, 3]
  Statistics stats;
  double seconds[8] = {};

  size_t bytes() const;
};

// Names of Frame::seconds.
enum Phase { kCull, kSelect, kBin, kScatter, kForward, kBackward, kReduce };

class Stopwatch {
 public:
  // Seconds since the last call.
  double lap() {
    const auto now = std::chrono::steady_clock::now();
    const double seconds = std::chrono::duration<double>(now - last_).count();
    last_ = now;
    return seconds;
  }

 private:
  std::chrono::steady_clock::time_point last_ = std::chrono::steady_clock::now();
};

// The phases, in order.
void cull(const Splats& splats, const TileGrid& grid, Buffer<float>& work, Candidates& out);

// Cuts the candidates into slabs; see slabs.cpp.
struct DepthSample {
  std::vector<float> depth;  // ascending
  std::vector<double> work;  // cumulative: tiles of the boxes up to and including this one
};
DepthSample sample_depths(const Candidates& candidates);
struct DepthRange {
  float low, high;    // low <= depth < high
  size_t begin, end;  // in the sample
};
DepthRange next_slab(const DepthSample& sample, const TileGrid& grid, const DepthRange& previous, int number);
void select_and_sort(const Frame& frame, const DepthSample& sample, const DepthRange& range, Slab& slab);

void make_records(const Splats& splats, const TileGrid& grid, const SlabPart& part, Record* records);
void note_tiles(const Frame& frame, const Splats& splats, Slab& slab);
void scatter_entries(const TileGrid& grid, Slab& slab);

void forward_tiles(Frame& frame, Slab& slab, bool last, const float background[3], const Picture& out,
                   bool counting);
void backward_tiles(Frame& frame, const float background[3], const PictureGradients& in, int64_t count);
void reduce_gradients(Frame& frame, const SplatGradients& out);
void share_tiles(Frame& frame, const float* lacking);
void reduce_shares(Frame& frame, float* pixels, float* missing);

// Gives every slab room for so many sums of each of its entries.
void room_for_sums(Frame& frame, size_t stride);
// Sums of share_tiles: weight, weight times what is lacking of red, green and blue.
constexpr size_t kShares = 4;

}  // namespace vdgs::raster
