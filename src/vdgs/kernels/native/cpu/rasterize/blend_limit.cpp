// What the blend loop of the rasterizer could do at best on this core: the same arithmetic on one block
// of pixels in registers, with its splats in the first-level cache and nothing around it. Benchmarks
// report the rasterizer as a share of it.
#include <chrono>

#include "bindings.h"
#include "cpu/rasterize/tile.h"

namespace {

using namespace vdgs;
using namespace vdgs::raster;

constexpr int kSplats = 64;

struct Pixels {
  F16 t, r, g, b;
};

VDGS_INLINE void blend(const Falloff& falloff, const float* paint, Pixels& px) {
  const F16 exponent = exponent_in_block(falloff, 0, paint[3]).value;
  const F16 alpha = zero_unless(reaches(exponent), min(exp2_bounded(exponent), splat(kAlphaMax)));
  const F16 weight = alpha * px.t;
  px.t = fnma(alpha, px.t, px.t);
  px.r = fma(weight, splat(paint[0]), px.r);
  px.g = fma(weight, splat(paint[1]), px.g);
  px.b = fma(weight, splat(paint[2]), px.b);
}

// Pairs of splat and pixel that one core blends per second, the best of several runs of `seconds` in all.
double blend_limit(double seconds) {
  static Falloff falloffs[kSplats];
  alignas(64) float paint[kSplats][4], out[kLanes];
  for (int j = 0; j < kSplats; ++j) {
    Record r{};
    r.ux = r.vy = 0.05f, r.uy = 0.01f;
    make_falloff(r, splat(0.1f * static_cast<float>(j)), splat(1.0f), falloffs[j]);
    paint[j][0] = paint[j][1] = paint[j][2] = 0.5f;
    paint[j][3] = -7.0f;  // faint, so that no pixel finishes
  }
  using Clock = std::chrono::steady_clock;
  const auto elapsed = [](Clock::time_point since) {
    return std::chrono::duration<double>(Clock::now() - since).count();
  };
  constexpr int kRounds = 2000;
  double best = 0;
  for (const auto start = Clock::now(); elapsed(start) < seconds;) {
    Pixels px{splat(1.0f), splat(0.0f), splat(0.0f), splat(0.0f)};
    const auto begin = Clock::now();
    for (int round = 0; round < kRounds; ++round) {
      px.t = splat(1.0f);  // or it would become denormal, and the processor slow
      for (int j = 0; j < kSplats; ++j) blend(falloffs[j], paint[j], px);
    }
    const double pairs = static_cast<double>(kRounds) * kSplats * kLanes;
    store(out, px.t + px.r + px.g + px.b);
    if (out[0] > -1.0f) best = std::max(best, pairs / elapsed(begin));
  }
  return best;
}

}  // namespace

VDGS_BIND(blend_limit) {
  m.def("blend_limit", &blend_limit, nb::arg("seconds") = 0.2, nb::call_guard<nb::gil_scoped_release>(),
        "Pairs of splat and pixel that one core can blend per second at best.");
}
