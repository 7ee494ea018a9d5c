// Small dense products with sixteen anchors as lanes: matrices are row-major, and a "column" of
// activations is sixteen floats, one per anchor.
#pragma once

#include <type_traits>

#include "simd/math.h"

namespace vdgs {

namespace detail {
template <int size, class Body>
VDGS_INLINE void last_block(int begin, int n, const Body& body) {
  if constexpr (size > 0) {
    if (n - begin == size) return body(std::integral_constant<int, size>{}, begin);
    last_block<size - 1>(begin, n, body);
  }
}
}  // namespace detail

// Splits 0 .. n-1 into blocks of `most`, and one of what is left; calls body(size as a type, begin).
template <int most, class Body>
VDGS_INLINE void in_blocks(int n, const Body& body) {
  int begin = 0;
  for (; begin + most <= n; begin += most) body(std::integral_constant<int, most>{}, begin);
  detail::last_block<most - 1>(begin, n, body);
}

// y_r = sum over c of w[r * row_stride + c * column_stride] x_c, for r < rows and c < columns;
// finish(r, sum) says what becomes of it, start(r) where the sum begins.
template <int row_stride, int column_stride, class Start, class Finish>
VDGS_INLINE void multiply(const float* w, int rows, int columns, const float* x, const Start& start,
                          const Finish& finish) {
  in_blocks<kAccumulators>(rows, [&](auto size, int begin) {
    constexpr int n = decltype(size)::value;
    F16 sum[n];
    for (int r = 0; r < n; ++r) sum[r] = start(begin + r);
    const float* block = w + begin * row_stride;
    for (int c = 0; c < columns; ++c) {
      const F16 input = load(x + kLanes * c);
      for (int r = 0; r < n; ++r) sum[r] = fma(splat(block[r * row_stride + c * column_stride]), input, sum[r]);
    }
    for (int r = 0; r < n; ++r) finish(begin + r, sum[r]);
  });
}

// out[r * width + c] += sum over anchors of g_r[anchor] rows[anchor * row_stride + c], for r < n. `g` has
// anchors as lanes; `rows` is the other factor transposed, so that its sums need no horizontal step.
template <int width, int row_stride>
VDGS_INLINE void add_outer_products(const float* g, int n, const float* rows, float* out) {
  constexpr int vectors = kAccumulators >= 16 ? 2 : 1;
  static_assert(width % (vectors * kLanes) == 0);
  in_blocks<kAccumulators / vectors>(n, [&](auto size, int begin) {
    constexpr int block = decltype(size)::value;
    for (int c = 0; c < width; c += vectors * kLanes) {
      F16 sum[block][vectors];
      float* target = out + begin * width + c;
      for (int r = 0; r < block; ++r)
        for (int v = 0; v < vectors; ++v) sum[r][v] = load(target + r * width + kLanes * v);
      for (int anchor = 0; anchor < kLanes; ++anchor) {
        F16 row[vectors];
        for (int v = 0; v < vectors; ++v) row[v] = load(rows + anchor * row_stride + c + kLanes * v);
        for (int r = 0; r < block; ++r) {
          const F16 factor = splat(g[(begin + r) * kLanes + anchor]);
          for (int v = 0; v < vectors; ++v) sum[r][v] = fma(factor, row[v], sum[r][v]);
        }
      }
      for (int r = 0; r < block; ++r)
        for (int v = 0; v < vectors; ++v) store(target + r * width + kLanes * v, sum[r][v]);
    }
  });
}

}  // namespace vdgs
