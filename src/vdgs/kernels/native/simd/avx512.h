// The sixteen lanes of simd.h as one AVX-512 register.
#pragma once

// GCC 12 warns about its own deliberately undefined registers (its bug 105593).
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"
#pragma GCC diagnostic ignored "-Wuninitialized"
#endif
#include <immintrin.h>
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC diagnostic pop
#endif

namespace vdgs {

struct F16 {
  __m512 v;
};
struct I16 {
  __m512i v;
};
struct M16 {
  __mmask16 m;
};

VDGS_INLINE F16 splat(float a) { return {_mm512_set1_ps(a)}; }
VDGS_INLINE I16 splat(int32_t a) { return {_mm512_set1_epi32(a)}; }

VDGS_INLINE M16 operator&(M16 a, M16 b) { return {static_cast<__mmask16>(a.m & b.m)}; }
VDGS_INLINE M16 operator|(M16 a, M16 b) { return {static_cast<__mmask16>(a.m | b.m)}; }
VDGS_INLINE M16 operator~(M16 a) { return {static_cast<__mmask16>(~a.m)}; }
VDGS_INLINE M16 andnot(M16 a, M16 b) { return {static_cast<__mmask16>(~a.m & b.m)}; }
VDGS_INLINE unsigned bits(M16 a) { return a.m; }
VDGS_INLINE M16 mask_of_bits(unsigned a) { return {static_cast<__mmask16>(a)}; }
VDGS_INLINE bool any(M16 a) { return a.m != 0; }
VDGS_INLINE bool none(M16 a) { return a.m == 0; }
VDGS_INLINE M16 first_lanes(int count) { return {static_cast<__mmask16>((1u << count) - 1u)}; }

VDGS_INLINE F16 load(const float* p) { return {_mm512_load_ps(p)}; }
VDGS_INLINE F16 loadu(const float* p) { return {_mm512_loadu_ps(p)}; }
VDGS_INLINE void store(float* p, F16 a) { _mm512_store_ps(p, a.v); }
VDGS_INLINE void storeu(float* p, F16 a) { _mm512_storeu_ps(p, a.v); }
VDGS_INLINE I16 load(const int32_t* p) { return {_mm512_load_si512(p)}; }
VDGS_INLINE I16 loadu(const int32_t* p) { return {_mm512_loadu_si512(p)}; }
VDGS_INLINE void store(int32_t* p, I16 a) { _mm512_store_si512(p, a.v); }
VDGS_INLINE void storeu(int32_t* p, I16 a) { _mm512_storeu_si512(p, a.v); }
VDGS_INLINE F16 load_first(const float* p, int count) {
  return {_mm512_maskz_loadu_ps(first_lanes(count).m, p)};
}
VDGS_INLINE void store_first(float* p, int count, F16 a) {
  _mm512_mask_storeu_ps(p, first_lanes(count).m, a.v);
}

VDGS_INLINE F16 operator+(F16 a, F16 b) { return {_mm512_add_ps(a.v, b.v)}; }
VDGS_INLINE F16 operator-(F16 a, F16 b) { return {_mm512_sub_ps(a.v, b.v)}; }
VDGS_INLINE F16 operator*(F16 a, F16 b) { return {_mm512_mul_ps(a.v, b.v)}; }
VDGS_INLINE F16 operator/(F16 a, F16 b) { return {_mm512_div_ps(a.v, b.v)}; }
VDGS_INLINE F16 fma(F16 a, F16 b, F16 c) { return {_mm512_fmadd_ps(a.v, b.v, c.v)}; }
VDGS_INLINE F16 fnma(F16 a, F16 b, F16 c) { return {_mm512_fnmadd_ps(a.v, b.v, c.v)}; }
VDGS_INLINE F16 min(F16 a, F16 b) { return {_mm512_min_ps(a.v, b.v)}; }
VDGS_INLINE F16 max(F16 a, F16 b) { return {_mm512_max_ps(a.v, b.v)}; }
VDGS_INLINE F16 abs(F16 a) { return {_mm512_abs_ps(a.v)}; }
VDGS_INLINE F16 sqrt(F16 a) { return {_mm512_sqrt_ps(a.v)}; }
VDGS_INLINE F16 floor(F16 a) {
  return {_mm512_roundscale_ps(a.v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC)};
}

// The 14-bit estimates of the processor, refined by one Newton step.
VDGS_INLINE F16 reciprocal(F16 a) {
  const F16 estimate{_mm512_rcp14_ps(a.v)};
  return fma(estimate, fnma(a, estimate, splat(1.0f)), estimate);
}
VDGS_INLINE F16 rsqrt(F16 a) {
  const F16 estimate{_mm512_rsqrt14_ps(a.v)};
  const F16 half_error = fnma(a * estimate, estimate, splat(1.0f)) * splat(0.5f);
  return fma(estimate, half_error, estimate);
}

VDGS_INLINE M16 lt(F16 a, F16 b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LT_OQ)}; }
VDGS_INLINE M16 le(F16 a, F16 b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LE_OQ)}; }
VDGS_INLINE M16 gt(F16 a, F16 b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GT_OQ)}; }
VDGS_INLINE M16 ge(F16 a, F16 b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ)}; }
VDGS_INLINE F16 select(M16 m, F16 a, F16 b) { return {_mm512_mask_blend_ps(m.m, b.v, a.v)}; }
VDGS_INLINE F16 zero_unless(M16 m, F16 a) { return {_mm512_maskz_mov_ps(m.m, a.v)}; }

VDGS_INLINE float hsum(F16 a) { return _mm512_reduce_add_ps(a.v); }
VDGS_INLINE void hsum4(float* out, F16 a, F16 b, F16 c, F16 d) {
  const __m512 ab = _mm512_add_ps(_mm512_unpacklo_ps(a.v, b.v), _mm512_unpackhi_ps(a.v, b.v));
  const __m512 cd = _mm512_add_ps(_mm512_unpacklo_ps(c.v, d.v), _mm512_unpackhi_ps(c.v, d.v));
  const __m512 abcd = _mm512_add_ps(_mm512_shuffle_ps(ab, cd, 0x44), _mm512_shuffle_ps(ab, cd, 0xEE));
  const __m256 half = _mm256_add_ps(_mm512_castps512_ps256(abcd), _mm512_extractf32x8_ps(abcd, 1));
  _mm_storeu_ps(out, _mm_add_ps(_mm256_castps256_ps128(half), _mm256_extractf128_ps(half, 1)));
}

// 2^a: relative error below 2e-7, underflow to 0, overflow to infinity, NaN stays NaN.
VDGS_INLINE F16 exp2(F16 a) {
  const F16 f{_mm512_reduce_ps(a.v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC)};  // a - floor(a)
  F16 p = splat(1.877576671e-03f);
  p = fma(p, f, splat(8.989340340e-03f));
  p = fma(p, f, splat(5.582631759e-02f));
  p = fma(p, f, splat(2.401536173e-01f));
  p = fma(p, f, splat(6.931530731e-01f));
  p = fma(p, f, splat(1.0f));
  return {_mm512_scalef_ps(p.v, a.v)};  // p * 2^floor(a)
}

VDGS_INLINE F16 exp2_bounded(F16 a) { return exp2(a); }

VDGS_INLINE I16 operator+(I16 a, I16 b) { return {_mm512_add_epi32(a.v, b.v)}; }
VDGS_INLINE I16 operator-(I16 a, I16 b) { return {_mm512_sub_epi32(a.v, b.v)}; }
VDGS_INLINE I16 operator&(I16 a, I16 b) { return {_mm512_and_si512(a.v, b.v)}; }
VDGS_INLINE I16 operator|(I16 a, I16 b) { return {_mm512_or_si512(a.v, b.v)}; }
template <int n>
VDGS_INLINE I16 shift_left(I16 a) {
  return {_mm512_slli_epi32(a.v, n)};
}
template <int n>
VDGS_INLINE I16 shift_right(I16 a) {
  return {_mm512_srli_epi32(a.v, n)};
}
VDGS_INLINE M16 lt(I16 a, I16 b) { return {_mm512_cmplt_epi32_mask(a.v, b.v)}; }
VDGS_INLINE I16 to_int(F16 a) { return {_mm512_cvttps_epi32(a.v)}; }
VDGS_INLINE F16 to_float(I16 a) { return {_mm512_cvtepi32_ps(a.v)}; }
VDGS_INLINE I16 bits_of(F16 a) { return {_mm512_castps_si512(a.v)}; }
VDGS_INLINE F16 float_of_bits(I16 a) { return {_mm512_castsi512_ps(a.v)}; }

namespace shuffles {
// Which of 32 lanes (first register: 0..15, second: 16..31) each lane of the result takes.
struct alignas(64) Index {
  int32_t lane[16];
};
constexpr Index every(int step, int first) {
  Index index{};
  for (int i = 0; i < 16; ++i) index.lane[i] = (first + step * i) & 31;
  return index;
}
// Second step of load3: keeps the lanes that the first two registers held, takes the rest from the third.
constexpr Index join3(int column) {
  Index index{};
  for (int i = 0; i < 16; ++i) index.lane[i] = column + 3 * i < 32 ? i : 16 + (column + 3 * i - 32);
  return index;
}
// store3: lane i of output register r is column (16 r + i) % 3 of row (16 r + i) / 3.
constexpr Index weave_xy(int r) {
  Index index{};
  for (int i = 0; i < 16; ++i) index.lane[i] = (16 * r + i) / 3 + ((16 * r + i) % 3 == 1 ? 16 : 0);
  return index;
}
constexpr Index weave_z(int r) {
  Index index{};
  for (int i = 0; i < 16; ++i) index.lane[i] = (16 * r + i) % 3 == 2 ? 16 + (16 * r + i) / 3 : i;
  return index;
}
VDGS_INLINE F16 pick(F16 a, const Index& index, F16 b) {
  return {_mm512_permutex2var_ps(a.v, _mm512_load_si512(index.lane), b.v)};
}
}  // namespace shuffles

VDGS_INLINE void load2(const float* p, F16& x, F16& y) {
  static constexpr shuffles::Index even = shuffles::every(2, 0), odd = shuffles::every(2, 1);
  const F16 a = loadu(p), b = loadu(p + 16);
  x = shuffles::pick(a, even, b);
  y = shuffles::pick(a, odd, b);
}
VDGS_INLINE void load3(const float* p, F16& x, F16& y, F16& z) {
  using shuffles::every;
  using shuffles::join3;
  static constexpr shuffles::Index first[3] = {every(3, 0), every(3, 1), every(3, 2)};
  static constexpr shuffles::Index second[3] = {join3(0), join3(1), join3(2)};
  const F16 a = loadu(p), b = loadu(p + 16), c = loadu(p + 32);
  x = shuffles::pick(shuffles::pick(a, first[0], b), second[0], c);
  y = shuffles::pick(shuffles::pick(a, first[1], b), second[1], c);
  z = shuffles::pick(shuffles::pick(a, first[2], b), second[2], c);
}
VDGS_INLINE void store3(float* p, F16 x, F16 y, F16 z) {
  using shuffles::weave_xy;
  using shuffles::weave_z;
  static constexpr shuffles::Index xy[3] = {weave_xy(0), weave_xy(1), weave_xy(2)};
  static constexpr shuffles::Index with_z[3] = {weave_z(0), weave_z(1), weave_z(2)};
  for (int r = 0; r < 3; ++r) storeu(p + 16 * r, shuffles::pick(shuffles::pick(x, xy[r], y), with_z[r], z));
}

// In a register first: compressing straight to memory is very slow on some processors.
VDGS_INLINE void compress_store(float* p, M16 m, F16 a) {
  store_first(p, __builtin_popcount(m.m), {_mm512_maskz_compress_ps(m.m, a.v)});
}
VDGS_INLINE void compress_store(int32_t* p, M16 m, I16 a) {
  const __mmask16 packed = first_lanes(__builtin_popcount(m.m)).m;
  _mm512_mask_storeu_epi32(p, packed, _mm512_maskz_compress_epi32(m.m, a.v));
}

VDGS_INLINE F16 load_quads(const float* p, ptrdiff_t stride) {
  __m512 r = _mm512_castps128_ps512(_mm_loadu_ps(p));
  r = _mm512_insertf32x4(r, _mm_loadu_ps(p + stride), 1);
  r = _mm512_insertf32x4(r, _mm_loadu_ps(p + 2 * stride), 2);
  return {_mm512_insertf32x4(r, _mm_loadu_ps(p + 3 * stride), 3)};
}
VDGS_INLINE void store_quads(float* p, ptrdiff_t stride, F16 a) {
  _mm_storeu_ps(p, _mm512_castps512_ps128(a.v));
  _mm_storeu_ps(p + stride, _mm512_extractf32x4_ps(a.v, 1));
  _mm_storeu_ps(p + 2 * stride, _mm512_extractf32x4_ps(a.v, 2));
  _mm_storeu_ps(p + 3 * stride, _mm512_extractf32x4_ps(a.v, 3));
}

VDGS_INLINE uint64_t bit_column(const uint16_t* masks, int bit) {
  const __m512i wanted = _mm512_set1_epi16(static_cast<short>(1u << bit));
  const uint64_t low = _mm512_test_epi16_mask(_mm512_load_si512(masks), wanted);
  const uint64_t high = _mm512_test_epi16_mask(_mm512_load_si512(masks + 32), wanted);
  return low | high << 32;
}
VDGS_INLINE void set_bit_column(uint16_t* masks, int bit, uint64_t column) {
  const __m512i wanted = _mm512_set1_epi16(static_cast<short>(1u << bit));
  const __m512i low = _mm512_load_si512(masks), high = _mm512_load_si512(masks + 32);
  const __m512i low_set = _mm512_or_si512(low, wanted), high_set = _mm512_or_si512(high, wanted);
  _mm512_store_si512(masks, _mm512_mask_mov_epi16(low, static_cast<__mmask32>(column), low_set));
  _mm512_store_si512(masks + 32, _mm512_mask_mov_epi16(high, static_cast<__mmask32>(column >> 32), high_set));
}

}  // namespace vdgs
