// Gradients and shares of the splats from the sums of their entries, added in a fixed order.
#include <algorithm>

#include "cpu/rasterize/frame.h"
#include "simd/simd.h"
#include "cpu/sums.h"
#include "threads.h"

namespace vdgs::raster {
namespace {

void clear(const SplatGradients& out, int64_t begin, int64_t end) {
  const size_t n = static_cast<size_t>(end - begin);
  std::memset(out.means + 2 * begin, 0, 8 * n);
  std::memset(out.conics + 3 * begin, 0, 12 * n);
  std::memset(out.colors + 3 * begin, 0, 12 * n);
  std::memset(out.opacities + begin, 0, 4 * n);
  if (out.depths) std::memset(out.depths + begin, 0, 4 * n);
}

// Says of a pick that it has no entry.
constexpr uint32_t kNowhere = UINT32_MAX;
alignas(64) constexpr float kZeros[32] = {};

// Adds up the entries of the first picks of a part, front to back, as they lie in the tiles. The total takes the
// place of the splat's first entry; part.scratch says of each pick where that is.
template <size_t kStride>
void add_entries(const Slab& slab, SlabPart& part, uint32_t picks) {
  constexpr uint32_t kAhead = 24;
  const uint32_t *first = part.first.data(), *where = part.where.data();
  const uint32_t n_entries = static_cast<uint32_t>(part.n_entries);
  const uint16_t* touched = slab.touched.data();
  float* sums = slab.sums;
  // What was not touched has no sums; to look elsewhere is cheaper than to branch.
  const auto row = [&](uint32_t k) { return touched[where[k]] ? sums + where[k] * kStride : kZeros; };
  DepthKey* total_of = part.scratch.reserve(static_cast<size_t>(part.count));
  for (int64_t i = 0; i < part.count; ++i) {
    if (part.order[i].pick >= picks) continue;
    // The first kStride lanes; in the others is what lies behind a row, which nobody reads.
    F16 total = splat(0.0f);
    for (uint32_t k = first[i]; k < first[i + 1]; ++k) {
      if (k + 2 * kAhead < n_entries) {
        __builtin_prefetch(touched + where[k + 2 * kAhead]);
        const float* later = row(k + kAhead);
        __builtin_prefetch(later);
        __builtin_prefetch(later + kStride - 1);
      }
      total = total + loadu(row(k));
    }
    const uint32_t place = first[i] < first[i + 1] ? where[first[i]] : kNowhere;
    if (place != kNowhere) store_first(sums + place * kStride, static_cast<int>(kStride), total);
    total_of[part.order[i].pick].pick = place;
  }
}

// With k = log2(e)/2 the exponent is  -(u^2 + v^2) / (2k),  u = ux dx + uy dy,  v = vy dy, and the conic
// k a = ux^2, k b = ux uy, k c = uy^2 + vy^2. So d/d(mean) = (a dx + b dy, b dx + c dy) =
// (ux u, uy u + vy v) / k, without the cancellation that dx and dy would bring to a thin splat.
VDGS_INLINE void write_gradients(const Record& r, const float* sum, int64_t i, const SplatGradients& out) {
  constexpr float kScale = 1.0f / kHalfLog2E;
  out.means[2 * i] = kScale * r.ux * sum[kSumU];
  out.means[2 * i + 1] = kScale * (r.uy * sum[kSumU] + r.vy * sum[kSumV]);
  // dy = v / vy,  dx = (u - uy/vy v) / ux
  const float y_per_v = 1.0f / r.vy, x_per_u = 1.0f / r.ux, shear = r.uy * y_per_v;
  const float uu = sum[kSumUU], uv = sum[kSumUV], vv = sum[kSumVV];
  out.conics[3 * i] = -0.5f * (uu - shear * (2.0f * uv - shear * vv)) * x_per_u * x_per_u;
  out.conics[3 * i + 1] = -(uv - shear * vv) * x_per_u * y_per_v;
  out.conics[3 * i + 2] = -0.5f * vv * y_per_v * y_per_v;
  out.opacities[i] = sum[kSum] / r.opacity;
  out.colors[3 * i] = sum[kSumRed];
  out.colors[3 * i + 1] = sum[kSumGreen];
  out.colors[3 * i + 2] = sum[kSumBlue];
  if (out.depths) out.depths[i] = sum[kSumDepth];
}

// Adds up what the entries of the first n splats came to, and calls write(record, total, i) for each splat i of
// them that was drawn.
template <size_t kStride, class Write>
void reduce(Frame& frame, int64_t n, const Write& write) {
  for (int s = 0; s < frame.n_slabs; ++s) {
    Slab& slab = *frame.slabs[s];
    parallel_for(slab.n_parts, [&](int64_t p) {
      SlabPart& part = *slab.parts[p];
      const int32_t* splat = part.splat.data();  // ascending
      const size_t count = static_cast<size_t>(std::lower_bound(splat, splat + part.count, n) - splat);
      add_entries<kStride>(slab, part, static_cast<uint32_t>(count));
      constexpr size_t kAhead = 16;
      const auto total = [&](size_t k) {
        const uint32_t place = part.scratch[k].pick;
        return place == kNowhere ? kZeros : slab.sums + place * kStride;
      };
      for (size_t k = 0; k < count; ++k) {
        if (k + kAhead < count) {
          __builtin_prefetch(total(k + kAhead));
          __builtin_prefetch(total(k + kAhead) + kStride - 1);
        }
        const Record& record = slab.records[static_cast<size_t>(part.begin) + k];
        if (record.columns != kNoTiles) write(record, total(k), static_cast<int64_t>(splat[k]));
      }
    });
  }
}

// Calls clear(begin, end) for n splats, part by part.
template <class Clear>
void clear_all(int64_t n, const Clear& clear) {
  parallel_parts(n, n_parts(n, 16384), [&](int, int64_t begin, int64_t end) { clear(begin, end); });
}

}  // namespace

void room_for_sums(Frame& frame, size_t stride) {
  size_t entries = 0;
  for (int s = 0; s < frame.n_slabs; ++s) entries += frame.slabs[s]->n_entries;
  float* sums = frame.work.reserve(entries * stride);
  for (int s = 0; s < frame.n_slabs; ++s) {
    frame.slabs[s]->sums = sums;
    sums += frame.slabs[s]->n_entries * stride;
  }
}

void reduce_gradients(Frame& frame, const SplatGradients& out) {
  clear_all(out.count, [&](int64_t begin, int64_t end) { clear(out, begin, end); });
  const auto write = [&](const Record& r, const float* sum, int64_t i) { write_gradients(r, sum, i, out); };
  if (frame.with_depth)
    reduce<n_sums(true)>(frame, out.count, write);
  else
    reduce<n_sums(false)>(frame, out.count, write);
  for (size_t c = 0; c < 3; ++c) {
    double sum = 0;
    for (size_t tile = 0; tile < static_cast<size_t>(frame.grid.tiles()); ++tile)
      sum += static_cast<double>(frame.background_sums[3 * tile + c]);
    out.background[c] = static_cast<float>(sum);
  }
}

void reduce_shares(Frame& frame, float* pixels, float* missing) {
  clear_all(frame.n_splats, [&](int64_t begin, int64_t end) {
    const size_t n = static_cast<size_t>(end - begin);
    std::memset(pixels + begin, 0, 4 * n);
    std::memset(missing + 3 * begin, 0, 12 * n);
  });
  reduce<kShares>(frame, frame.n_splats, [&](const Record&, const float* sum, int64_t i) {
    pixels[i] = sum[0];
    for (int64_t c = 0; c < 3; ++c) missing[3 * i + c] = sum[1 + c];
  });
}

}  // namespace vdgs::raster
