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

// The gradients of a pick, kept where its record was.
struct alignas(64) PickGradients {
  float mean[2], conic[3], colour[3], opacity, depth;
};
static_assert(sizeof(PickGradients) == sizeof(Record));

// With k = log2(e)/2 the exponent is  -(u^2 + v^2) / (2k),  u = ux dx + uy dy,  v = vy dy, and the conic
// k a = ux^2, k b = ux uy, k c = uy^2 + vy^2. So d/d(mean) = (a dx + b dy, b dx + c dy) =
// (ux u, uy u + vy v) / k, without the cancellation that dx and dy would bring to a thin splat.
VDGS_INLINE PickGradients gradients_of(const Record& r, const float* sum) {
  constexpr float kScale = 1.0f / kHalfLog2E;
  // dy = v / vy,  dx = (u - uy/vy v) / ux
  const float y_per_v = 1.0f / r.vy, x_per_u = 1.0f / r.ux, shear = r.uy * y_per_v;
  const float uu = sum[kSumUU], uv = sum[kSumUV], vv = sum[kSumVV];
  const float xx = (uu - shear * (2.0f * uv - shear * vv)) * x_per_u * x_per_u;
  const float xy = (uv - shear * vv) * x_per_u * y_per_v;
  const float yy = vv * y_per_v * y_per_v;
  return {{kScale * r.ux * sum[kSumU], kScale * (r.uy * sum[kSumU] + r.vy * sum[kSumV])},
          {-0.5f * xx, -xy, -0.5f * yy},
          {sum[kSumRed], sum[kSumGreen], sum[kSumBlue]},
          sum[kSum] / r.opacity,
          sum[kSumDepth]};
}

// Adds up the entries of every splat of a part, in depth order, as they lie in the tiles.
template <bool with_depth>
void add_entries(const Slab& slab, SlabPart& part) {
  constexpr size_t kStride = n_sums(with_depth);
  constexpr uint32_t kEntriesAhead = 24;
  constexpr int64_t kPicksAhead = 8;
  const uint32_t *first = part.first.data(), *where = part.where.data();
  const uint32_t n_entries = static_cast<uint32_t>(part.n_entries);
  const float* sums = slab.sums.data();
  const DepthKey* order = part.order.data();
  PickGradients* picks = reinterpret_cast<PickGradients*>(part.picks.data());
  for (int64_t i = 0; i < part.count; ++i) {
    if (i + kPicksAhead < part.count) __builtin_prefetch(picks + order[i + kPicksAhead].pick, 1);
    if (first[i] == first[i + 1]) {
      picks[order[i].pick] = {};
      continue;
    }
    F16 total = splat(0.0f);  // its first kStride lanes; the others add up what nobody reads
    for (uint32_t k = first[i]; k < first[i + 1]; ++k) {
      if (k + kEntriesAhead < n_entries) {
        const float* later = sums + where[k + kEntriesAhead] * kStride;
        __builtin_prefetch(later);
        __builtin_prefetch(later + kStride - 1);
      }
      total = total + loadu(sums + where[k] * kStride);
    }
    alignas(64) float sum[kLanes];
    store(sum, total);
    picks[order[i].pick] = gradients_of(slab.records[static_cast<size_t>(part.rank_begin + i)], sum);
  }
}

// Puts the gradients where they belong, in the order of the input.
void write_gradients(const SlabPart& part, const SplatGradients& out) {
  const PickGradients* picks = reinterpret_cast<const PickGradients*>(part.picks.data());
  for (int64_t k = 0; k < part.count; ++k) {
    const int64_t i = part.splat[static_cast<size_t>(k)];
    const PickGradients& g = picks[k];
    std::memcpy(out.means + 2 * i, g.mean, sizeof g.mean);
    std::memcpy(out.conics + 3 * i, g.conic, sizeof g.conic);
    std::memcpy(out.colours + 3 * i, g.colour, sizeof g.colour);
    out.opacities[i] = g.opacity;
    if (out.depths) out.depths[i] = g.depth;
  }
}

}  // namespace

void reduce_gradients(Frame& frame, const SplatGradients& out) {
  parallel_parts(frame.n_splats, n_parts(frame.n_splats, 16384),
                 [&](int, int64_t begin, int64_t end) { clear(out, begin, end); });
  const auto add = frame.with_depth ? add_entries<true> : add_entries<false>;
  for (int s = 0; s < frame.n_slabs; ++s) {
    const Slab& slab = *frame.slabs[static_cast<size_t>(s)];
    parallel_for(slab.n_parts, [&](int64_t p) {
      SlabPart& part = *slab.parts[static_cast<size_t>(p)];
      add(slab, part);
      write_gradients(part, out);
    });
  }
  for (size_t c = 0; c < 3; ++c) {
    double sum = 0;
    for (size_t tile = 0; tile < static_cast<size_t>(frame.grid.tiles()); ++tile)
      sum += static_cast<double>(frame.background_sums[3 * tile + c]);
    out.background[c] = static_cast<float>(sum);
  }
}

}  // namespace vdgs::raster
