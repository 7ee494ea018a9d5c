// One register of vector.h, as the vector extension of GCC and Clang sees it, and what the
// extension cannot say in one instruction.
#pragma once

#if defined(__SSE2__)
#include <immintrin.h>
#endif

namespace vdgs {

#if defined(__AVX2__)
constexpr int kPartLanes = 8;
#else
constexpr int kPartLanes = 4;
#endif
constexpr int kParts = 16 / kPartLanes;

typedef float FloatPart __attribute__((vector_size(kPartLanes * 4)));
typedef int32_t IntPart __attribute__((vector_size(kPartLanes * 4)));
typedef uint32_t UintPart __attribute__((vector_size(kPartLanes * 4)));

namespace part {
#if defined(__AVX2__)
VDGS_INLINE FloatPart min(FloatPart a, FloatPart b) { return _mm256_min_ps(a, b); }
VDGS_INLINE FloatPart max(FloatPart a, FloatPart b) { return _mm256_max_ps(a, b); }
VDGS_INLINE FloatPart sqrt(FloatPart a) { return _mm256_sqrt_ps(a); }
VDGS_INLINE FloatPart select(IntPart m, FloatPart a, FloatPart b) {
  return _mm256_blendv_ps(b, a, (__m256)m);
}
VDGS_INLINE unsigned bits(IntPart m) { return static_cast<unsigned>(_mm256_movemask_ps((__m256)m)); }
VDGS_INLINE IntPart truncate(FloatPart a) { return (IntPart)_mm256_cvttps_epi32(a); }
#else
VDGS_INLINE FloatPart select(IntPart m, FloatPart a, FloatPart b) {
  return (FloatPart)(((IntPart)a & m) | ((IntPart)b & ~m));
}
#if defined(__SSE2__)
VDGS_INLINE FloatPart min(FloatPart a, FloatPart b) { return _mm_min_ps(a, b); }
VDGS_INLINE FloatPart max(FloatPart a, FloatPart b) { return _mm_max_ps(a, b); }
VDGS_INLINE FloatPart sqrt(FloatPart a) { return _mm_sqrt_ps(a); }
VDGS_INLINE unsigned bits(IntPart m) { return static_cast<unsigned>(_mm_movemask_ps((__m128)m)); }
VDGS_INLINE IntPart truncate(FloatPart a) { return (IntPart)_mm_cvttps_epi32(a); }
#else
VDGS_INLINE FloatPart min(FloatPart a, FloatPart b) { return select((IntPart)(a < b), a, b); }
VDGS_INLINE FloatPart max(FloatPart a, FloatPart b) { return select((IntPart)(a > b), a, b); }
VDGS_INLINE FloatPart sqrt(FloatPart a) {
  for (int i = 0; i < kPartLanes; ++i) a[i] = __builtin_sqrtf(a[i]);
  return a;
}
VDGS_INLINE unsigned bits(IntPart m) {
  const IntPart weighted = m & IntPart{1, 2, 4, 8};
  return static_cast<unsigned>(weighted[0] | weighted[1] | weighted[2] | weighted[3]);
}
VDGS_INLINE IntPart truncate(FloatPart a) {
  // Conversion of what does not fit is undefined in C++: such lanes become INT32_MIN, as on x86.
  const IntPart fits = (IntPart)((a < 2147483648.0f) & (a >= -2147483648.0f));
  const IntPart whole = __builtin_convertvector((FloatPart)((IntPart)a & fits), IntPart);
  return (whole & fits) | (~fits & INT32_MIN);
}
#endif
#endif
}  // namespace part

}  // namespace vdgs
