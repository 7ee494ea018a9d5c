// Anchors to splats: sixteen anchors at a time through the three heads, then offset by offset through
// activation and projection, then out in the order of anchors.
#include "cpu/decode/decode.h"

#include <mutex>
#include <vector>

#include "threads.h"

namespace vdgs {
namespace {

constexpr int64_t kPiece = 256;  // anchors per task

// A splat on its way out of the decoder, in one piece of sixteen words, so that sixteen splats are a
// transpose and one splat is one register.
struct Splat {
  float x, y, conic_xx, conic_xy, conic_yy, depth, red, green, blue, opacity, volume;
  int32_t source;
  float unused[4];
};
static_assert(sizeof(Splat) == 16 * sizeof(float));

// Room for the splats of a piece of consecutive anchors.
struct Piece {
  std::unique_ptr<Splat[]> splats;
  int64_t capacity = 0, count = 0;
};

// The pieces of a wave: as many as keep all threads busy, few enough to stay in the caches and to be kept
// for the next view. (The system asks for more time to hand out fresh pages than it takes to fill them.)
class Wave {
 public:
  Wave(int64_t pieces, int64_t capacity) {
    {
      const std::unique_lock<std::mutex> lock(mutex(), std::try_to_lock);
      if (lock) pieces_.swap(kept());
    }
    while (static_cast<int64_t>(pieces_.size()) < pieces) pieces_.emplace_back();
    for (Piece& piece : pieces_)
      if (piece.capacity < capacity)
        piece = {std::unique_ptr<Splat[]>(new Splat[static_cast<size_t>(capacity)]), capacity, 0};
  }
  ~Wave() {
    const std::unique_lock<std::mutex> lock(mutex(), std::try_to_lock);
    if (lock && kept().size() < pieces_.size()) kept().swap(pieces_);
  }
  Wave(const Wave&) = delete;
  Wave& operator=(const Wave&) = delete;

  Piece& operator[](int64_t i) { return pieces_[static_cast<size_t>(i)]; }

 private:
  // Never destroyed: a thread may decode while the process ends. Never waited for: in a forked child it stays locked
  // where another thread of the parent held it, and pieces can be made anew.
  static std::mutex& mutex() {
    static auto* const mutex = new std::mutex;
    return *mutex;
  }
  static std::vector<Piece>& kept() {
    static auto* const pieces = new std::vector<Piece>;
    return *pieces;
  }

  std::vector<Piece> pieces_;
};

struct alignas(64) Outputs {
  float opacity[kMaxOffsets * kLanes];
  float covariance[7 * kMaxOffsets * kLanes];
  float color[3 * kMaxOffsets * kLanes];
};

// Splats of one batch by offset and anchor, and which are kept (one bit per anchor).
struct alignas(64) Spawned {
  Splat splats[kMaxOffsets][kLanes];
  unsigned kept[kMaxOffsets];
};

M16 opaque(const Outputs& outputs, int offset) {
  return le(splat(kAlphaMin), load(outputs.opacity + offset * kLanes));
}

// Opacities of all offsets; whether any is opaque.
bool decode_opacity(WeightLayout layout, const float* weights, const Batch& batch, Outputs& outputs) {
  output_layer(layout, weights, 0, batch, outputs.opacity);
  M16 some = mask_of_bits(0);
  for (int j = 0; j < layout.k; ++j) {
    float* opacity = outputs.opacity + j * kLanes;
    store(opacity, zero_unless(batch.usable, tanh(load(opacity))));
    some = some | opaque(outputs, j);
  }
  return any(some);
}

void spawn_offset(const Camera& camera, const Batch& batch, const Outputs& outputs, I16 source, int j,
                  Spawned& out) {
  const M16 wanted = opaque(outputs, j);
  out.kept[j] = 0;
  if (none(wanted)) return;
  const float* o = batch.offsets + 3 * j * kLanes;
  F16 covariance[7];
  for (int i = 0; i < 7; ++i) covariance[i] = load(outputs.covariance + (7 * j + i) * kLanes);
  const Gaussian<F16> gaussian =
      spawn(batch.anchor, Vec3<F16>{load(o), load(o + kLanes), load(o + 2 * kLanes)}, covariance);
  const Projection<F16> p = project(camera, gaussian);
  const F16 opacity = load(outputs.opacity + j * kLanes);
  const M16 kept = wanted & p.valid & on_image(camera, p, opacity);
  out.kept[j] = bits(kept);
  if (none(kept)) return;
  const float* rgb = outputs.color + 3 * j * kLanes;
  const F16 fields[12] = {p.drawn.x, p.drawn.y, p.drawn.conic_xx, p.drawn.conic_xy, p.drawn.conic_yy,
                          p.drawn.depth, sigmoid(load(rgb)), sigmoid(load(rgb + kLanes)),
                          sigmoid(load(rgb + 2 * kLanes)), opacity,
                          gaussian.scale.x * gaussian.scale.y * gaussian.scale.z, float_of_bits(source)};
  alignas(64) float columns[kLanes * kLanes];
  for (int f = 0; f < kLanes; ++f) store(columns + f * kLanes, f < 12 ? fields[f] : splat(0.0f));
  transpose16(columns, kLanes, &out.splats[j][0].x, kLanes);
}

// Appends what was kept, anchor by anchor.
void emit(const Spawned& spawned, int k, Piece& out) {
  uint32_t offsets_of[kLanes] = {};
  for (int j = 0; j < k; ++j)
    for (int lane = 0; lane < kLanes; ++lane) offsets_of[lane] |= ((spawned.kept[j] >> lane) & 1u) << j;
  for (int lane = 0; lane < kLanes; ++lane)
    for (uint32_t left = offsets_of[lane]; left; left &= left - 1)
      out.splats[static_cast<size_t>(out.count++)] = spawned.splats[__builtin_ctz(left)][lane];
}

// k times the index of each lane's anchor: the sources of its first splat.
I16 first_sources(int64_t first, int k) {
  alignas(64) int32_t sources[kLanes];
  for (int lane = 0; lane < kLanes; ++lane) sources[lane] = static_cast<int32_t>((first + lane) * k);
  return load(sources);
}

void decode_piece(const AnchorArrays& anchors, WeightLayout layout, const float* weights, const Camera& camera,
                  int64_t begin, int64_t end, Piece& out) {
  Batch batch;
  Outputs outputs;
  Spawned spawned;
  for (int64_t first = begin; first < end; first += kLanes) {
    load_batch(anchors, camera, first, batch);
    hidden_layer(weights, batch);
    if (!decode_opacity(layout, weights, batch, outputs)) continue;
    output_layer(layout, weights, 1, batch, outputs.covariance);
    output_layer(layout, weights, 2, batch, outputs.color);
    const I16 sources = first_sources(first, layout.k);
    for (int j = 0; j < layout.k; ++j) spawn_offset(camera, batch, outputs, sources + splat(j), j, spawned);
    emit(spawned, layout.k, out);
  }
}

// Writes the splats of a piece as rows from m on.
void write_piece(const Piece& piece, size_t m, const DecodedView& out) {
  float *means_px = out.means_px.data(), *conics = out.conics.data(), *colors = out.colors.data();
  float *depths = out.depths.data(), *opacities = out.opacities.data(), *volumes = out.volumes.data();
  int32_t* source = out.source.data();
  for (int64_t j = 0; j < piece.count; ++j) {
    const Splat& s = piece.splats[static_cast<size_t>(j)];
    means_px[2 * m] = s.x, means_px[2 * m + 1] = s.y;
    conics[3 * m] = s.conic_xx, conics[3 * m + 1] = s.conic_xy, conics[3 * m + 2] = s.conic_yy;
    colors[3 * m] = s.red, colors[3 * m + 1] = s.green, colors[3 * m + 2] = s.blue;
    depths[m] = s.depth, opacities[m] = s.opacity, volumes[m] = s.volume;
    source[m] = s.source;
    ++m;
  }
}

}  // namespace

DecodedView decode(const AnchorArrays& anchors, WeightLayout layout, const float* weights, const Camera& camera) {
  DecodedView view(static_cast<size_t>(anchors.count * layout.k));
  const int64_t pieces = (anchors.count + kPiece - 1) / kPiece;
  const int64_t at_once = std::min(pieces, std::max<int64_t>(32, 8 * threads()));
  Wave wave(at_once, kPiece * layout.k);
  std::vector<size_t> begins(static_cast<size_t>(at_once));
  for (int64_t first = 0; first < pieces; first += at_once) {
    const int64_t n = std::min(at_once, pieces - first);
    parallel_for(n, [&](int64_t i) {
      const int64_t begin = (first + i) * kPiece;
      wave[i].count = 0;
      decode_piece(anchors, layout, weights, camera, begin, std::min(anchors.count, begin + kPiece), wave[i]);
    });
    for (int64_t i = 0; i < n; ++i) {
      begins[static_cast<size_t>(i)] = view.count;
      view.count += static_cast<size_t>(wave[i].count);
    }
    parallel_for(n, [&](int64_t i) { write_piece(wave[i], begins[static_cast<size_t>(i)], view); });
  }
  const size_t m = view.count;
  view.means_px.fit(2 * m), view.conics.fit(3 * m), view.depths.fit(m), view.colors.fit(3 * m);
  view.opacities.fit(m), view.volumes.fit(m), view.source.fit(m);
  return view;
}

}  // namespace vdgs
