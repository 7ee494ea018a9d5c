// Rows of a few numbers, sixteen at a time, to and from columns: the lanes are the rows.
#pragma once

#include <algorithm>
#include <cstdint>

#include "simd/simd.h"

namespace vdgs {

// A number in half precision (IEEE 754 binary16), by its bits.
struct Half {
  uint16_t bits;
};

VDGS_INLINE F16 from_half(I16 bits) {
  const I16 magnitude = bits & splat(0x7fff), sign = shift_left<16>(bits & splat(0x8000));
  const I16 shifted = shift_left<13>(magnitude);
  // 112 is what the exponents of both formats begin apart; the largest one stands for infinity and NaN, the
  // least for multiples of 2^-24.
  const F16 small = to_float(magnitude) * splat(5.9604644775390625e-8f);
  const F16 finite = select(lt(magnitude, splat(0x0400)), small, float_of_bits(shifted + splat(112 << 23)));
  const F16 beyond = float_of_bits(shifted | splat(0x7f800000));
  const F16 value = select(lt(magnitude, splat(0x7c00)), finite, beyond);
  return float_of_bits(bits_of(value) | sign);
}

// Sixteen rows of `width` numbers from row `first` on; behind the last row, the last again.
template <int width>
VDGS_INLINE void load_columns(const float* rows, int64_t first, int64_t n, F16 (&out)[width]) {
  alignas(64) float columns[width][kLanes];
  for (int lane = 0; lane < kLanes; ++lane)
    for (int i = 0; i < width; ++i) columns[i][lane] = rows[std::min(first + lane, n - 1) * width + i];
  for (int i = 0; i < width; ++i) out[i] = load(columns[i]);
}

template <int width>
VDGS_INLINE void load_columns(const Half* rows, int64_t first, int64_t n, F16 (&out)[width]) {
  alignas(64) int32_t columns[width][kLanes];
  for (int lane = 0; lane < kLanes; ++lane)
    for (int i = 0; i < width; ++i) columns[i][lane] = rows[std::min(first + lane, n - 1) * width + i].bits;
  for (int i = 0; i < width; ++i) out[i] = from_half(load(columns[i]));
}

template <int width>
VDGS_INLINE void store_columns(float* rows, int64_t first, int64_t n, const F16 (&values)[width]) {
  alignas(64) float columns[width][kLanes];
  for (int i = 0; i < width; ++i) store(columns[i], values[i]);
  const int count = static_cast<int>(std::min<int64_t>(kLanes, n - first));
  for (int lane = 0; lane < count; ++lane)
    for (int i = 0; i < width; ++i) rows[(first + lane) * width + i] = columns[i][lane];
}

}  // namespace vdgs
