// Gradients of the splats from the sums of their entries, added in a fixed order.
#include "frame.h"
#include "simd.h"
#include "sums.h"
#include "threads.h"

namespace vdgs::raster {
namespace {

void clear(const SplatGradients& out, int64_t begin, int64_t end) {
  const size_t n = static_cast<size_t>(end - begin);
  std::memset(out.means + 2 * begin, 0, 8 * n);
  std::memset(out.conics + 3 * begin, 0, 12 * n);
  std::memset(out.colours + 3 * begin, 0, 12 * n);
  std::memset(out.opacities + begin, 0, 4 * n);
  if (out.depths) std::memset(out.depths + begin, 0, 4 * n);
}

// With k = log2(e)/2 the exponent is  -(u^2 + v^2) / (2k),  u = ux dx + uy dy,  v = vy dy, and the conic
// k a = ux^2, k b = ux uy, k c = uy^2 + vy^2. So d/d(mean) = (a dx + b dy, b dx + c dy) =
// (ux u, uy u + vy v) / k, without the cancellation that dx and dy would bring to a thin splat.
void write_gradients(const Record& r, const float* sum, int64_t i, const SplatGradients& out) {
  constexpr float kScale = 1.0f / kHalfLog2E;
  out.means[2 * i] = kScale * r.ux * sum[kSumU];
  out.means[2 * i + 1] = kScale * (r.uy * sum[kSumU] + r.vy * sum[kSumV]);
  // dy = v / vy,  dx = (u - uy/vy v) / ux
  const float y_per_v = 1.0f / r.vy, x_per_u = 1.0f / r.ux, shear = r.uy * y_per_v;
  const float xx = (sum[kSumUU] - shear * (2.0f * sum[kSumUV] - shear * sum[kSumVV])) * x_per_u * x_per_u;
  const float xy = (sum[kSumUV] - shear * sum[kSumVV]) * x_per_u * y_per_v;
  out.conics[3 * i] = -0.5f * xx;
  out.conics[3 * i + 1] = -xy;
  out.conics[3 * i + 2] = -0.5f * sum[kSumVV] * y_per_v * y_per_v;
  out.opacities[i] = sum[kSum] / r.opacity;
  out.colours[3 * i] = sum[kSumRed];
  out.colours[3 * i + 1] = sum[kSumGreen];
  out.colours[3 * i + 2] = sum[kSumBlue];
  if (out.depths) out.depths[i] = sum[kSumDepth];
}

void prefetch_for_writing(const SplatGradients& out, int64_t i) {
  __builtin_prefetch(out.means + 2 * i, 1);
  __builtin_prefetch(out.conics + 3 * i, 1);
  __builtin_prefetch(out.colours + 3 * i, 1);
  __builtin_prefetch(out.opacities + i, 1);
}

template <bool with_depth>
void reduce_part(const Slab& slab, const SlabPart& part, const SplatGradients& out) {
  constexpr int kStride = n_sums(with_depth);
  constexpr uint32_t kEntriesAhead = 24;
  constexpr int64_t kSplatsAhead = 8;
  const uint32_t *first = part.first.data(), *where = part.where.data();
  const uint32_t n_entries = static_cast<uint32_t>(part.n_entries);
  const float* sums = slab.sums.data();
  for (int64_t i = 0; i < part.count; ++i) {
    if (i + kSplatsAhead < part.count) prefetch_for_writing(out, part.order[static_cast<size_t>(i + kSplatsAhead)].splat);
    if (first[i] == first[i + 1]) continue;
    F16 total = splat(0.0f);  // its first kStride lanes; the others add up what nobody reads
    for (uint32_t k = first[i]; k < first[i + 1]; ++k) {
      if (k + kEntriesAhead < n_entries) {
        const float* later = sums + size_t{where[k + kEntriesAhead]} * kStride;
        __builtin_prefetch(later);
        __builtin_prefetch(later + kStride - 1);
      }
      total = total + loadu(sums + size_t{where[k]} * kStride);
    }
    alignas(64) float sum[kLanes];
    store(sum, total);
    write_gradients(slab.records[static_cast<size_t>(part.rank_begin + i)], sum, part.order[static_cast<size_t>(i)].splat, out);
  }
}

}  // namespace

void reduce_gradients(Frame& frame, const SplatGradients& out) {
  parallel_parts(frame.n_splats, n_parts(frame.n_splats, 4096),
                 [&](int, int64_t begin, int64_t end) { clear(out, begin, end); });
  for (int s = 0; s < frame.n_slabs; ++s) {
    const Slab& slab = *frame.slabs[static_cast<size_t>(s)];
    const auto reduce = frame.with_depth ? reduce_part<true> : reduce_part<false>;
    parallel_for(slab.n_parts, [&](int64_t p) { reduce(slab, *slab.parts[static_cast<size_t>(p)], out); });
  }
  double background[3] = {};
  for (size_t i = 0; i < 3 * static_cast<size_t>(frame.grid.tiles()); ++i)
    background[i % 3] += static_cast<double>(frame.background_sums[i]);
  for (int c = 0; c < 3; ++c) out.background[c] = static_cast<float>(background[c]);
}

}  // namespace vdgs::raster
