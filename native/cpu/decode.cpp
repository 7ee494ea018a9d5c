// Anchors to splats: sixteen anchors at a time through the three heads, then offset by offset through
// activation and projection, then out in the order of anchors.
#include "decode.h"

#include <mutex>

#include "threads.h"

namespace vdgs {
namespace {

constexpr int64_t kPiece = 256;                      // anchors per task
constexpr int64_t kStoredSplats = int64_t{1} << 20;  // 64 MiB, the most that the store keeps

// Memory of pieces that are done. Never destroyed: views may outlive everything else.
struct Store {
  std::mutex mutex;
  std::vector<Piece> pieces;
  int64_t capacity = 0;

  Piece take(int64_t wanted) {
    {
      const std::lock_guard<std::mutex> lock(mutex);
      if (!pieces.empty() && pieces.back().capacity >= wanted) {
        Piece piece = std::move(pieces.back());
        pieces.pop_back();
        capacity -= piece.capacity;
        return piece;
      }
    }
    return {std::unique_ptr<Splat[]>(new Splat[static_cast<size_t>(wanted)]), wanted, 0};
  }

  void give_back(Piece piece) {
    const std::lock_guard<std::mutex> lock(mutex);
    if (capacity + piece.capacity > kStoredSplats) return;
    capacity += piece.capacity;
    piece.count = 0;
    pieces.push_back(std::move(piece));
  }
};

Store& store_of_pieces() {
  static Store* const store = new Store;
  return *store;
}

struct alignas(64) Outputs {
  float opacity[kMaxOffsets * kLanes];
  float covariance[7 * kMaxOffsets * kLanes];
  float colour[3 * kMaxOffsets * kLanes];
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
  const float* rgb = outputs.colour + 3 * j * kLanes;
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
    output_layer(layout, weights, 2, batch, outputs.colour);
    const I16 sources = first_sources(first, layout.k);
    for (int j = 0; j < layout.k; ++j) spawn_offset(camera, batch, outputs, sources + splat(j), j, spawned);
    emit(spawned, layout.k, out);
  }
}

}  // namespace

DecodedView::~DecodedView() {
  for (Piece& piece : pieces)
    if (piece.splats) store_of_pieces().give_back(std::move(piece));
}

DecodedView decode(const AnchorArrays& anchors, WeightLayout layout, const float* weights, const Camera& camera) {
  DecodedView view;
  const int64_t n = (anchors.count + kPiece - 1) / kPiece;
  view.pieces.resize(static_cast<size_t>(n));
  parallel_for(n, [&](int64_t i) {
    Piece& piece = view.pieces[static_cast<size_t>(i)];
    piece = store_of_pieces().take(kPiece * layout.k);
    decode_piece(anchors, layout, weights, camera, i * kPiece, std::min(anchors.count, (i + 1) * kPiece), piece);
  });
  for (const Piece& piece : view.pieces) view.count += piece.count;
  return view;
}

void write_splats(const DecodedView& view, const SplatArrays& out) {
  std::vector<int64_t> begins(view.pieces.size());
  int64_t total = 0;
  for (size_t i = 0; i < begins.size(); ++i) {
    begins[i] = total;
    total += view.pieces[i].count;
  }
  parallel_for(static_cast<int64_t>(begins.size()), [&](int64_t i) {
    int64_t m = begins[static_cast<size_t>(i)];
    const Piece& piece = view.pieces[static_cast<size_t>(i)];
    for (int64_t j = 0; j < piece.count; ++j) {
      const Splat& s = piece.splats[static_cast<size_t>(j)];
      out.means_px[2 * m] = s.x, out.means_px[2 * m + 1] = s.y;
      out.conics[3 * m] = s.conic_xx, out.conics[3 * m + 1] = s.conic_xy, out.conics[3 * m + 2] = s.conic_yy;
      out.colours[3 * m] = s.red, out.colours[3 * m + 1] = s.green, out.colours[3 * m + 2] = s.blue;
      out.depths[m] = s.depth, out.opacities[m] = s.opacity, out.volumes[m] = s.volume;
      out.source[m] = s.source;
      ++m;
    }
  });
}

}  // namespace vdgs
