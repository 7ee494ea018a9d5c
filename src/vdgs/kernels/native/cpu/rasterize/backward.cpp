// Gradients of the entries of every tile, back to front.
//
// Per pixel, with T_i before entry i and G = dL/d(image): the derivative with respect to alpha_i is
//     T_i color_i . G  -  behind_i / (1 - alpha_i),   behind_i = what lies behind i, times G.
// T_i is recovered from T_i+1 by division. Every entry ends up with ten sums over its pixels, from
// which reduce_gradients makes the gradients of the splat.
//
// Gradients may be wanted of the first splats only: what a block trains stands first, what lies around it and
// never moves after it. Entries of the others leave no sums: they take part in T and in what lies behind, and
// those in front of a tile's first wanted entry not even in that.
#include "cpu/sums.h"
#include "threads.h"
#include "cpu/rasterize/tile.h"

namespace vdgs::raster {
namespace {

struct alignas(64) TileGradients {
  float transmittance[kTilePixels];  // behind the entry at hand
  float behind[kTilePixels];
  float image[3][kTilePixels];
  float depth[kTilePixels];
  float stop[kTilePixels];
};

// Reads the picture's gradients; `background_sums` receives those of the background.
void load_gradients(const Frame& frame, int tile, const float background[3], const PictureGradients& in,
                    TileGradients& g, float background_sums[3]) {
  const F16 zero = splat(0.0f);
  if (!is_whole(frame.grid, tile) || !in.image || !in.alpha) std::memset(&g, 0, sizeof g);
  for_each_pixel_row(frame.grid, tile, [&](int n, int place, int64_t pixel) {
    F16 r = zero, gr = zero, b = zero;
    if (in.image) read_row3(in.image + 3 * pixel, n, r, gr, b);
    store_quads(g.image[0] + place, kLanes, r);
    store_quads(g.image[1] + place, kLanes, gr);
    store_quads(g.image[2] + place, kLanes, b);
    store_quads(g.behind + place, kLanes, in.alpha ? zero - read_row(in.alpha + pixel, n) : zero);
    if (frame.with_depth)
      store_quads(g.depth + place, kLanes, in.depth ? read_row(in.depth + pixel, n) : zero);
  });
  const size_t first = static_cast<size_t>(tile) * kTilePixels;
  const F16 b0 = splat(background[0]), b1 = splat(background[1]), b2 = splat(background[2]);
  F16 s0 = zero, s1 = zero, s2 = zero;
  for (int i = 0; i < kTilePixels; i += kLanes) {
    const F16 t = load(frame.transmittance.data() + first + static_cast<size_t>(i));
    const F16 g0 = load(g.image[0] + i), g1 = load(g.image[1] + i), g2 = load(g.image[2] + i);
    store(g.transmittance + i, t);
    store(g.behind + i, fma(b0, g0, fma(b1, g1, fma(b2, g2, load(g.behind + i)))));
    s0 = fma(t, g0, s0), s1 = fma(t, g1, s1), s2 = fma(t, g2, s2);
  }
  background_sums[0] = hsum(s0), background_sums[1] = hsum(s1), background_sums[2] = hsum(s2);
  if (frame.any_stop[tile]) std::memcpy(g.stop, frame.stop.data() + first, sizeof g.stop);
}

// One entry: all blocks that it touched. Without sums if its gradients are not `wanted`.
template <bool with_depth, bool any_stop, bool wanted>
VDGS_INLINE void entry_gradients(const Record& r, const BlockOrigins& origins, unsigned touched, float order,
                                 TileGradients& g, float* out) {
  Falloff falloff;
  make_falloff(r, origins.x - splat(r.mean_x), origins.y - splat(r.mean_y), falloff);
  const F16 one = splat(1.0f), zero = splat(0.0f);
  // Two loops: the first is one long chain of dependent steps per block, of which the processor can
  // keep several under way only if nothing else fills its queue.
  alignas(64) float alphas[kTileBlocks][kLanes], inverses[kTileBlocks][kLanes];
  for (unsigned rest = touched; rest; rest &= rest - 1) {
    const int block = __builtin_ctz(rest);
    const F16 exponent = exponent_in_block(falloff, block, r.log2_opacity).value;
    M16 reached = reaches(exponent);
    if (any_stop) reached = reached & lt(splat(order), load(g.stop + block * kLanes));
    const F16 alpha = zero_unless(reached, min(exp2_bounded(exponent), splat(kAlphaMax)));
    store(alphas[block], alpha);
    store(inverses[block], reciprocal(one - alpha));
  }
  const F16 red = splat(r.color[0]), green = splat(r.color[1]), blue = splat(r.color[2]);
  F16 s0 = zero, su = zero, sv = zero, suu = zero, suv = zero, svv = zero;
  F16 w_red = zero, w_green = zero, w_blue = zero, w_depth = zero;
  for (; touched; touched &= touched - 1) {
    const int block = __builtin_ctz(touched), at = block * kLanes;
    // Where alpha is 0 everything below leaves the pixel exactly as it was.
    const F16 alpha = load(alphas[block]), inverse = load(inverses[block]);
    const F16 t_behind = load(g.transmittance + at);
    const F16 t = fma(alpha * t_behind, inverse, t_behind);
    const F16 g0 = load(g.image[0] + at), g1 = load(g.image[1] + at), g2 = load(g.image[2] + at);
    F16 shade = fma(red, g0, fma(green, g1, blue * g2));
    const F16 gd = with_depth ? load(g.depth + at) : zero;
    if (with_depth) shade = fma(splat(r.depth), gd, shade);
    const F16 behind = load(g.behind + at);
    const F16 difference = shade - behind;
    store(g.transmittance + at, t);
    store(g.behind + at, fma(alpha, difference, behind));
    if (!wanted) continue;
    const F16 weight = alpha * t;
    if (with_depth) w_depth = fma(weight, gd, w_depth);
    // dL/d(exponent), which a clamped alpha does not depend on.
    const F16 s = zero_unless(lt(alpha, splat(kAlphaMax)), weight * difference);
    w_red = fma(weight, g0, w_red), w_green = fma(weight, g1, w_green), w_blue = fma(weight, g2, w_blue);
    const F16 u = load(falloff.u_pixel) + splat(falloff.u_block[block]);
    const F16 v = load(falloff.v_pixel) + splat(falloff.v_block[block]);
    const F16 s_u = s * u, s_v = s * v;
    s0 = s0 + s, su = su + s_u, sv = sv + s_v;
    suu = fma(s_u, u, suu), suv = fma(s_u, v, suv), svv = fma(s_v, v, svv);
  }
  if (!wanted) return;
  hsum4(out + kSum, s0, su, sv, suu);
  hsum4(out + kSumUV, suv, svv, w_red, w_green);
  out[kSumBlue] = hsum(w_blue);
  if (with_depth) out[kSumDepth] = hsum(w_depth);
}

// The first entry of a tile whose gradients are wanted, by its slab and its place in it.
struct Front {
  int slab;
  uint32_t entry;
};

// Behind all slabs if there is none.
Front front_of(const Frame& frame, int tile, int64_t count) {
  for (int s = 0; s < frame.n_slabs; ++s) {
    const Slab& slab = *frame.slabs[s];
    const size_t begin = slab.tile_begin[tile];
    const uint32_t n = slab.visited[tile];
    const uint32_t* entries = slab.entries.data() + begin;
    const uint16_t* touched = slab.touched.data() + begin;
    for (uint32_t i = 0; i < n; ++i) {
      if (i + 12 < n) __builtin_prefetch(slab.records.data() + entries[i + 12]);
      if (touched[i] && slab.records[entries[i]].splat < count) return {s, i};
    }
  }
  return {frame.n_slabs, 0};
}

// The entries of a tile in a slab, from the last to the one at `front`.
template <bool with_depth, bool any_stop>
void slab_gradients(const Frame& frame, Slab& slab, int tile, uint32_t front, int64_t count, uint32_t& seen,
                    TileGradients& g) {
  constexpr int kStride = n_sums(with_depth);
  const BlockOrigins origins(frame.grid, tile);
  const size_t begin = slab.tile_begin[tile];
  const uint32_t n = slab.visited[tile];
  const uint32_t* entries = slab.entries.data() + begin;
  const uint16_t* touched = slab.touched.data() + begin;
  float* sums = slab.sums + begin * kStride;
  seen -= n;
  for (uint32_t i = n; i-- > front;) {
    if (i >= 12) __builtin_prefetch(slab.records.data() + entries[i - 12]);
    if (!touched[i]) continue;
    const Record& record = slab.records[entries[i]];
    float* const out = sums + i * size_t{kStride};
    if (record.splat < count)
      entry_gradients<with_depth, any_stop, true>(record, origins, touched[i], order_of(seen + i), g, out);
    else
      entry_gradients<with_depth, any_stop, false>(record, origins, touched[i], order_of(seen + i), g, out);
  }
}

template <bool with_depth>
void tile_gradients(Frame& frame, int tile, const float background[3], const PictureGradients& in,
                    int64_t count) {
  const size_t index = static_cast<size_t>(tile);
  TileGradients g;
  load_gradients(frame, tile, background, in, g, frame.background_sums.data() + 3 * index);
  const Front front = count < frame.n_splats ? front_of(frame, tile, count) : Front{0, 0};
  uint32_t seen = 0;
  for (int s = 0; s < frame.n_slabs; ++s) seen += frame.slabs[s]->visited[index];
  const auto through =
      frame.any_stop[index] ? slab_gradients<with_depth, true> : slab_gradients<with_depth, false>;
  for (int s = frame.n_slabs; s-- > front.slab;)
    through(frame, *frame.slabs[s], tile, s == front.slab ? front.entry : 0, count, seen, g);
}

}  // namespace

void backward_tiles(Frame& frame, const float background[3], const PictureGradients& in, int64_t count) {
  constexpr int kTilesPerTask = 4;
  const int tiles = frame.grid.tiles();
  frame.background_sums.reserve(3 * static_cast<size_t>(tiles));
  room_for_sums(frame, static_cast<size_t>(n_sums(frame.with_depth)));
  const auto gradients = frame.with_depth ? tile_gradients<true> : tile_gradients<false>;
  parallel_for((tiles + kTilesPerTask - 1) / kTilesPerTask, [&](int64_t task) {
    const int begin = static_cast<int>(task) * kTilesPerTask;
    for (int tile = begin; tile < std::min(tiles, begin + kTilesPerTask); ++tile)
      gradients(frame, tile, background, in, count);
  });
}

}  // namespace vdgs::raster
