// Sixteen float lanes, whatever the processor offers: one 512-bit register (AVX-512), two 256-bit
// ones (AVX2) or four 128-bit ones (any other processor, through the compiler's vector extension).
//
// This file and those that it includes are the only ones that know an instruction set. Everything
// is a free function on three value types:
//
//     F16   sixteen floats           M16   sixteen yes/no           I16   sixteen int32
//
// Arithmetic on NaN and infinity follows IEEE; min and max return their second argument when either
// is NaN; every comparison with NaN is false. No function traps or reads outside what it names.
#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <utility>

#define VDGS_INLINE inline __attribute__((always_inline))

#if defined(__AVX512F__) && defined(__AVX512DQ__) && defined(__AVX512BW__) && defined(__AVX512VL__)
#include "simd/avx512.h"
#else
#include "simd/vector.h"
#endif

namespace vdgs {

constexpr int kLanes = 16;

// What avx512.h and vector.h both define:
//
//   splat(float), splat(int32_t)           all lanes alike
//   load, store                            64-byte aligned;  loadu, storeu: any alignment
//   load_first(p, n), store_first(p, n, x) the first n lanes only (0 <= n <= 16); other lanes load 0
//   + - * /  fma(a,b,c)=ab+c  fnma(a,b,c)=c-ab  min max abs sqrt floor
//   reciprocal(a), rsqrt(a)                1/a and 1/sqrt(a) for positive normal a, to 2 ulp
//   lt le gt ge                            M16;   & | ~ andnot(a,b) = !a & b
//   select(m, a, b)                        m ? a : b
//   zero_unless(m, a)                      m ? a : 0
//   bits(m), mask_of_bits(u), any(m), none(m), first_lanes(n)
//   hsum(a)                                sum of the lanes;  hsum4(out, a, b, c, d): four sums at once
//   exp2(a)                                2^a to 2.5e-7; underflow 0, overflow infinity, NaN stays NaN
//   exp2_bounded(a)                        the same, faster, for -126 < a < 127 (elsewhere: any value)
//   to_int(a) (truncates), to_float(i), bits_of(a), float_of_bits(i)
//   I16: + - & | shift_left<n> shift_right<n> (logical) load store loadu storeu lt
//   load2/load3(p, x, y, ..), store3(..)   rows of two or three floats, to and from columns
//   compress_store(p, m, a)                the chosen lanes, packed; writes no more than those
//   load_quads(p, stride), store_quads     lanes 4i .. 4i+3 at p + i stride
//   bit_column(masks, b)                   bit b of 64 aligned uint16 as one uint64
//   set_bit_column(masks, b, u)            ors it back into them

// 1/a where a may be zero, infinite or NaN; one division per lane.
VDGS_INLINE F16 exact_reciprocal(F16 a) { return splat(1.0f) / a; }

// log2 of positive normal numbers: absolute error below 1e-7 (1 + |log2 a|).
VDGS_INLINE F16 log2(F16 a) {
  // The mantissa is taken to [sqrt(1/2), sqrt(2)), so that the polynomial's argument straddles 0.
  const I16 exponent = shift_right<23>(bits_of(a) + splat(0x3f800000 - 0x3f3504f3)) - splat(127);
  const F16 x = float_of_bits(bits_of(a) - shift_left<23>(exponent)) - splat(1.0f);
  F16 p = splat(1.258370366e-01f);
  p = fma(p, x, splat(-2.072698157e-01f));
  p = fma(p, x, splat(2.157156311e-01f));
  p = fma(p, x, splat(-2.389448139e-01f));
  p = fma(p, x, splat(2.879162451e-01f));
  p = fma(p, x, splat(-3.607036830e-01f));
  p = fma(p, x, splat(4.809106430e-01f));
  p = fma(p, x, splat(-7.213473468e-01f));
  p = fma(p, x, splat(1.442695004e+00f));
  return fma(p, x, to_float(exponent));
}

// e^a: 0 below about -87, infinity above 88.7, NaN stays NaN. Relative error below 3e-6 at |a| = 80,
// 2e-7 near 0 (the product a log2(e) is rounded).
VDGS_INLINE F16 exp(F16 a) { return exp2(a * splat(1.44269504088896341f)); }

// Natural logarithm of positive normal numbers.
VDGS_INLINE F16 log(F16 a) { return log2(a) * splat(0.693147180559945309f); }

// 1 / (1 + e^-a), exact limits on both sides.
VDGS_INLINE F16 sigmoid(F16 a) { return exact_reciprocal(splat(1.0f) + exp(splat(0.0f) - a)); }

VDGS_INLINE F16 clamp(F16 a, float low, float high) { return min(max(a, splat(low)), splat(high)); }

}  // namespace vdgs
