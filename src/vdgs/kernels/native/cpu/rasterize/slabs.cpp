// Slabs: how many splats to draw before looking which tiles are finished, and their order.
//
// A sample of the depths tells where to cut, so that nothing is sorted before it is known to be
// needed. Each thread picks the candidates of its own range of depth and sorts them alone.
#include <algorithm>
#include <limits>
#include <stdexcept>

#include "cpu/rasterize/frame.h"
#include "simd/simd.h"
#include "threads.h"

namespace vdgs::raster {
namespace {

constexpr float kInfinity = std::numeric_limits<float>::infinity();

// Work of the first slab per tile (box tiles), and how much deeper each next slab is. Measured: most tiles of
// a scene that hides anything are finished after 200 to 400 entries, and an unfinished one costs 12 kB of
// memory traffic per slab.
constexpr double kFirstSlabPerTile = 400, kSlabGrowth = 1.6;

// The bits of a float in the order of its value (negative ones flipped; -0 is 0).
uint32_t key_of_depth(float depth) {
  uint32_t u;
  std::memcpy(&u, &depth, 4);
  if ((u << 1) == 0) u = 0;
  return u ^ (static_cast<uint32_t>(-static_cast<int32_t>(u >> 31)) | 0x80000000u);
}

int64_t box_tiles(int32_t columns, int32_t rows) {
  const auto extent = [](int32_t packed) { return (packed >> 16) - (packed & 0xffff) + 1; };
  return static_cast<int64_t>(extent(columns)) * extent(rows);
}

// How many unfinished tiles a box holds, by the summed-area table.
int32_t open_tiles(const Frame& frame, int32_t columns, int32_t rows) {
  const int stride = frame.grid.columns + 1;
  const int32_t* above = frame.open_before.data() + static_cast<int64_t>(rows & 0xffff) * stride;
  const int32_t* below = frame.open_before.data() + static_cast<int64_t>((rows >> 16) + 1) * stride;
  const int left = columns & 0xffff, right = (columns >> 16) + 1;
  return below[right] - below[left] - above[right] + above[left];
}

// The candidates of [low, high), in the order of the input, without those behind finished tiles.
void select(const Frame& frame, float low, float high, bool first_slab, SlabPart& part) {
  const Candidates& all = frame.candidates;
  const F16 low16 = splat(low), high16 = splat(high);
  size_t n = 0;
  for (size_t chunk = 0; chunk < all.chunk_count.size(); ++chunk) {
    const size_t begin = chunk * Candidates::kChunk;
    const size_t end = begin + static_cast<size_t>(all.chunk_count[chunk]);
    for (size_t i = begin; i < end; i += kLanes) {
      const F16 depth = load_first(all.depth + i, static_cast<int>(std::min<size_t>(kLanes, end - i)));
      unsigned chosen = bits(ge(depth, low16) & lt(depth, high16));
      if (end - i < kLanes) chosen &= (1u << (end - i)) - 1u;
      if (!chosen) continue;
      DepthKey* order = part.order.grow(n, n + kLanes);
      int32_t* splat = part.splat.grow(n, n + kLanes);
      for (; chosen; chosen &= chosen - 1) {
        const size_t j = i + static_cast<size_t>(__builtin_ctz(chosen));
        if (!first_slab && open_tiles(frame, all.columns[j], all.rows[j]) == 0) continue;
        order[n] = {key_of_depth(all.depth[j]), static_cast<uint32_t>(n)};
        splat[n++] = all.splat[j];
      }
    }
  }
  part.count = static_cast<int64_t>(n);
}

// Stable radix sort by depth: splats of equal depth keep the order of the input.
void sort(SlabPart& part) {
  const size_t n = static_cast<size_t>(part.count);
  if (n < 2) return;
  DepthKey *from = part.order.data(), *to = part.scratch.reserve(n);
  uint32_t least = from[0].key, most = from[0].key;
  for (size_t i = 1; i < n; ++i) least = std::min(least, from[i].key), most = std::max(most, from[i].key);
  if (least == most) return;
  const int key_bits = 32 - __builtin_clz(most - least);
  const int passes = (key_bits + 10) / 11, digit_bits = (key_bits + passes - 1) / passes;
  const uint32_t digits = 1u << digit_bits;

  uint32_t begin[3][1 << 11] = {};
  for (size_t i = 0; i < n; ++i)
    for (int p = 0; p < passes; ++p) ++begin[p][((from[i].key - least) >> (p * digit_bits)) & (digits - 1)];
  for (int p = 0; p < passes; ++p) {
    uint32_t total = 0;
    for (uint32_t d = 0; d < digits; ++d) total += std::exchange(begin[p][d], total);
    for (size_t i = 0; i < n; ++i)
      to[begin[p][((from[i].key - least) >> (p * digit_bits)) & (digits - 1)]++] = from[i];
    std::swap(from, to);
  }
  if (from != part.order.data()) part.order.swap(part.scratch);
}

}  // namespace

DepthSample sample_depths(const Candidates& all) {
  const int64_t stride = std::max<int64_t>(16, all.count / 4096);
  std::vector<std::pair<float, double>> sample;
  int64_t next = 0, before = 0;  // counted over all candidates
  for (size_t chunk = 0; chunk < all.chunk_count.size(); ++chunk) {
    for (; next < before + all.chunk_count[chunk]; next += stride) {
      const size_t i = chunk * Candidates::kChunk + static_cast<size_t>(next - before);
      sample.emplace_back(all.depth[i], static_cast<double>(box_tiles(all.columns[i], all.rows[i])));
    }
    before += all.chunk_count[chunk];
  }
  std::sort(sample.begin(), sample.end());
  double work = 0;
  for (const auto& s : sample) work += s.second;
  const double scale = work > 0 ? all.tiles / work : 1.0;
  DepthSample out;
  work = 0;
  for (const auto& s : sample) {
    work += s.second * scale;
    out.depth.push_back(s.first);
    out.work.push_back(work);
  }
  return out;
}

DepthRange next_slab(const DepthSample& sample, const TileGrid& grid, const DepthRange& previous,
                     int number) {
  double per_tile = kFirstSlabPerTile;
  for (int i = 0; i < number; ++i) per_tile *= kSlabGrowth;
  const double wanted = per_tile * grid.tiles();
  const size_t begin = previous.end, n = sample.depth.size();
  DepthRange range{previous.high, kInfinity, begin, n};
  const double before = begin ? sample.work[begin - 1] : 0.0;
  if (n == 0 || sample.work.back() - before <= 1.5 * wanted) return range;
  const auto end = std::lower_bound(sample.work.begin() + static_cast<ptrdiff_t>(begin), sample.work.end(),
                                    before + wanted);
  range.end = static_cast<size_t>(end - sample.work.begin());
  while (range.end < n && !(sample.depth[range.end] > range.low)) ++range.end;
  if (range.end < n) range.high = sample.depth[range.end];
  return range;
}

void select_and_sort(const Frame& frame, const DepthSample& sample, const DepthRange& range, Slab& slab) {
  const double share =
      static_cast<double>(range.end - range.begin) / std::max<double>(1, sample.depth.size());
  slab.n_parts = n_parts(static_cast<int64_t>(share * static_cast<double>(frame.candidates.count)), 4096);
  while (static_cast<int>(slab.parts.size()) < slab.n_parts)
    slab.parts.push_back(std::make_unique<SlabPart>());
  const bool first_slab = range.begin == 0;
  // A splat costs about as much as its tiles: parts of equal number would differ in work.
  const auto work_before = [&](size_t i) { return i ? sample.work[i - 1] : 0.0; };
  const double before = work_before(range.begin), work = work_before(range.end) - before;
  const auto cut = [&](int part) {
    if (part == 0) return range.low;
    if (part == slab.n_parts) return range.high;
    const auto at = std::lower_bound(sample.work.begin() + static_cast<ptrdiff_t>(range.begin),
                                     sample.work.begin() + static_cast<ptrdiff_t>(range.end),
                                     before + work * part / slab.n_parts);
    const size_t index = static_cast<size_t>(at - sample.work.begin());
    return std::max(range.low, sample.depth[std::min(index, range.end - 1)]);
  };
  parallel_for(slab.n_parts, [&](int64_t p) {
    SlabPart& part = *slab.parts[p];
    select(frame, cut(static_cast<int>(p)), cut(static_cast<int>(p) + 1), first_slab, part);
    sort(part);
  });
  slab.count = 0;
  for (int p = 0; p < slab.n_parts; ++p) {
    slab.parts[p]->begin = slab.count;
    slab.count += slab.parts[p]->count;
  }
}

}  // namespace vdgs::raster
