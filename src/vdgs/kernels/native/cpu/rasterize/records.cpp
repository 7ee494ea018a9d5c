// Records of the splats of a slab, made in the order of the input.
#include <cmath>

#include "cpu/rasterize/tile.h"

namespace vdgs::raster {
namespace {

// Sixteen splats, field by field.
struct alignas(64) Sixteen {
  float x[16], y[16], a[16], b[16], c[16], det[16], opacity[16];
  float ux[16], uy[16], vy[16], log2_opacity[16], best_y[16], best_x[16];
  int32_t columns[16], rows[16];
};

void gather_splats(const Splats& s, const int32_t* splat, int n, Sixteen& out) {
  for (int k = 0; k < n; ++k) {
    const int64_t i = splat[k];
    const float a = s.conics[3 * i], b = s.conics[3 * i + 1], c = s.conics[3 * i + 2];
    out.x[k] = s.means[2 * i], out.y[k] = s.means[2 * i + 1];
    out.a[k] = a, out.b[k] = b, out.c[k] = c;
    // In double the products are exact: a splat seen edge-on keeps the right width.
    out.det[k] = static_cast<float>(static_cast<double>(a) * c - static_cast<double>(b) * b);
    out.opacity[k] = s.opacities[i];
  }
}

VDGS_INLINE I16 pack(F16 first, F16 last) { return to_int(first) | shift_left<16>(to_int(last)); }

VDGS_INLINE void derive(Sixteen& s, const TileGrid& grid) {
  const F16 a = load(s.a), b = load(s.b), c = load(s.c), det = load(s.det);
  const F16 inverse_a = splat(1.0f) / a, b_over_a = b * inverse_a;
  const F16 log2_opacity = log2(load(s.opacity));
  const F16 scale = (log2_opacity - splat(kLog2AlphaMin - kExponentSlack)) * splat(1.0f / kHalfLog2E) / det;
  const F16 ux = sqrt(splat(kHalfLog2E) * a);
  store(s.ux, ux);
  store(s.uy, ux * b_over_a);
  store(s.vy, sqrt(splat(kHalfLog2E) * det * inverse_a));
  store(s.log2_opacity, log2_opacity);
  store(s.best_y, splat(0.0f) - b / c);
  store(s.best_x, splat(0.0f) - b_over_a);
  const TileInterval columns = tile_interval(load(s.x), sqrt(scale * c) + splat(1e-3f), grid.width);
  const TileInterval rows = tile_interval(load(s.y), sqrt(scale * a) + splat(1e-3f), grid.height);
  const M16 drawn = columns.hit & rows.hit & gt(det, splat(0.0f));
  const F16 none_first = splat(static_cast<float>(kNoTiles));
  store(s.columns, pack(select(drawn, columns.first, none_first), zero_unless(drawn, columns.last)));
  store(s.rows, pack(zero_unless(drawn, rows.first), zero_unless(drawn, rows.last)));
}

Record record_of(const Sixteen& s, int k, const Splats& splats, int32_t splat) {
  const float* color = splats.colors + 3 * static_cast<int64_t>(splat);
  const bool finite = std::fabs(color[0]) + std::fabs(color[1]) + std::fabs(color[2]) < __builtin_inff();
  const uint32_t columns = finite ? static_cast<uint32_t>(s.columns[k]) : kNoTiles;
  return {s.x[k],
          s.y[k],
          s.ux[k],
          s.uy[k],
          s.vy[k],
          s.log2_opacity[k],
          {color[0], color[1], color[2]},
          splats.depths[splat],
          s.best_y[k],
          s.best_x[k],
          s.opacity[k],
          columns,
          static_cast<uint32_t>(s.rows[k]),
          static_cast<uint32_t>(splat)};
}

}  // namespace

void make_records(const Splats& splats, const TileGrid& grid, const SlabPart& part, Record* records) {
  Sixteen sixteen = {};
  for (int64_t i = 0; i < part.count; i += kLanes) {
    const int n = static_cast<int>(std::min<int64_t>(kLanes, part.count - i));
    const int32_t* splat = part.splat.data() + i;
    gather_splats(splats, splat, n, sixteen);
    derive(sixteen, grid);
    for (int k = 0; k < n; ++k) records[i + k] = record_of(sixteen, k, splats, splat[k]);
  }
}

}  // namespace vdgs::raster
