// What the decoder needs beyond simd.h: tanh, transposes, and how much fits in the registers.
#pragma once

#include "simd/simd.h"

#if defined(__SSE2__)
#include <immintrin.h>
#endif

namespace vdgs {

// Accumulators of sixteen lanes that a matrix product keeps in registers.
#if defined(__AVX512F__)
constexpr int kAccumulators = 16;
#elif defined(__AVX2__)
constexpr int kAccumulators = 6;
#else
constexpr int kAccumulators = 2;
#endif

// Hyperbolic tangent, relative error below 1e-6: the odd series near zero, where 1 - e^(-2a) cancels.
VDGS_INLINE F16 tanh(F16 a) {
  const F16 square = a * a;
  F16 p = splat(-8.863235530e-03f);
  p = fma(p, square, splat(2.186948854e-02f));
  p = fma(p, square, splat(-5.396825397e-02f));
  p = fma(p, square, splat(1.333333333e-01f));
  p = fma(p, square, splat(-3.333333333e-01f));
  const F16 near_zero = fma(p * square, a, a);
  const F16 t = splat(2.0f) * sigmoid(a + a) - splat(1.0f);
  return select(lt(abs(a), splat(0.3f)), near_zero, t);
}

// Sixteen rows of sixteen floats, `from` apart, become sixteen columns, `to` apart. All rows begin at
// multiples of 16 bytes. In and out do not overlap.
#if defined(__AVX512F__)
VDGS_INLINE void transpose16(const float* in, ptrdiff_t from, float* out, ptrdiff_t to) {
  __m512 r[16], t[16];
  for (int i = 0; i < 16; ++i) r[i] = _mm512_loadu_ps(in + i * from);
  for (int i = 0; i < 16; i += 2) {
    t[i] = _mm512_unpacklo_ps(r[i], r[i + 1]);
    t[i + 1] = _mm512_unpackhi_ps(r[i], r[i + 1]);
  }
  for (int i = 0; i < 16; i += 4) {
    r[i] = _mm512_shuffle_ps(t[i], t[i + 2], 0x44);
    r[i + 1] = _mm512_shuffle_ps(t[i], t[i + 2], 0xEE);
    r[i + 2] = _mm512_shuffle_ps(t[i + 1], t[i + 3], 0x44);
    r[i + 3] = _mm512_shuffle_ps(t[i + 1], t[i + 3], 0xEE);
  }
  // r[4 q + c] holds, in quarter b, column 4 b + c of rows 4 q .. 4 q + 3.
  for (int c = 0; c < 4; ++c) {
    const __m512 low01 = _mm512_shuffle_f32x4(r[c], r[4 + c], 0x44), high01 = _mm512_shuffle_f32x4(r[c], r[4 + c], 0xEE);
    const __m512 low23 = _mm512_shuffle_f32x4(r[8 + c], r[12 + c], 0x44);
    const __m512 high23 = _mm512_shuffle_f32x4(r[8 + c], r[12 + c], 0xEE);
    _mm512_storeu_ps(out + c * to, _mm512_shuffle_f32x4(low01, low23, 0x88));
    _mm512_storeu_ps(out + (4 + c) * to, _mm512_shuffle_f32x4(low01, low23, 0xDD));
    _mm512_storeu_ps(out + (8 + c) * to, _mm512_shuffle_f32x4(high01, high23, 0x88));
    _mm512_storeu_ps(out + (12 + c) * to, _mm512_shuffle_f32x4(high01, high23, 0xDD));
  }
}
#elif defined(__SSE2__)
VDGS_INLINE void transpose16(const float* in, ptrdiff_t from, float* out, ptrdiff_t to) {
  for (int row = 0; row < 16; row += 4) {
    for (int column = 0; column < 16; column += 4) {
      const float* p = in + row * from + column;
      __m128 a = _mm_loadu_ps(p), b = _mm_loadu_ps(p + from), c = _mm_loadu_ps(p + 2 * from),
             d = _mm_loadu_ps(p + 3 * from);
      _MM_TRANSPOSE4_PS(a, b, c, d);
      float* q = out + column * to + row;
      _mm_storeu_ps(q, a), _mm_storeu_ps(q + to, b), _mm_storeu_ps(q + 2 * to, c), _mm_storeu_ps(q + 3 * to, d);
    }
  }
}
#else
VDGS_INLINE void transpose16(const float* in, ptrdiff_t from, float* out, ptrdiff_t to) {
  for (int row = 0; row < 16; ++row)
    for (int column = 0; column < 16; ++column) out[column * to + row] = in[row * from + column];
}
#endif

}  // namespace vdgs
