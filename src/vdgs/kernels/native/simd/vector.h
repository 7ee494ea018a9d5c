// The sixteen lanes of simd.h as two AVX2 registers, or as four of 128 bits through the vector
// extension of GCC and Clang (which also serves processors that are not x86).
#pragma once

#include "simd/part.h"

namespace vdgs {

struct F16 {
  FloatPart v[kParts];
};
struct I16 {
  IntPart v[kParts];
};
struct M16 {
  IntPart m[kParts];  // all ones or all zeros
};

// Runs the statement for every part; the compiler unrolls it.
#define VDGS_EACH for (int k = 0; k < kParts; ++k)

VDGS_INLINE F16 splat(float a) {
  F16 r;
  VDGS_EACH r.v[k] = FloatPart{} + a;
  return r;
}
VDGS_INLINE I16 splat(int32_t a) {
  I16 r;
  VDGS_EACH r.v[k] = IntPart{} + a;
  return r;
}

VDGS_INLINE M16 operator&(M16 a, M16 b) {
  VDGS_EACH a.m[k] &= b.m[k];
  return a;
}
VDGS_INLINE M16 operator|(M16 a, M16 b) {
  VDGS_EACH a.m[k] |= b.m[k];
  return a;
}
VDGS_INLINE M16 operator~(M16 a) {
  VDGS_EACH a.m[k] = ~a.m[k];
  return a;
}
VDGS_INLINE M16 andnot(M16 a, M16 b) {
  VDGS_EACH a.m[k] = ~a.m[k] & b.m[k];
  return a;
}
VDGS_INLINE unsigned bits(M16 a) {
  unsigned r = 0;
  VDGS_EACH r |= part::bits(a.m[k]) << (k * kPartLanes);
  return r;
}
VDGS_INLINE bool any(M16 a) {
  IntPart joined = a.m[0];
  for (int k = 1; k < kParts; ++k) joined |= a.m[k];
  return part::bits(joined) != 0;
}
VDGS_INLINE bool none(M16 a) { return !any(a); }
VDGS_INLINE M16 mask_of_bits(unsigned u) {
  M16 r;
  IntPart weight;
  for (int i = 0; i < kPartLanes; ++i) weight[i] = 1 << i;
  VDGS_EACH r.m[k] = ((IntPart{} + static_cast<int32_t>(u >> (k * kPartLanes))) & weight) != 0;
  return r;
}
VDGS_INLINE M16 first_lanes(int count) { return mask_of_bits((1u << count) - 1u); }

// Part by part: as one copy of 64 bytes the compiler would take the long way round, through the stack.
#define VDGS_LOADS_AND_STORES(Lanes, Scalar)                                                           \
  typedef Scalar Aligned##Lanes##Part __attribute__((vector_size(kPartLanes * 4), may_alias));         \
  typedef Scalar Any##Lanes##Part __attribute__((vector_size(kPartLanes * 4), aligned(4), may_alias)); \
  VDGS_INLINE Lanes load(const Scalar* p) {                                                            \
    Lanes r;                                                                                           \
    VDGS_EACH r.v[k] = *reinterpret_cast<const Aligned##Lanes##Part*>(p + k * kPartLanes);             \
    return r;                                                                                          \
  }                                                                                                    \
  VDGS_INLINE Lanes loadu(const Scalar* p) {                                                           \
    Lanes r;                                                                                           \
    VDGS_EACH r.v[k] = *reinterpret_cast<const Any##Lanes##Part*>(p + k * kPartLanes);                 \
    return r;                                                                                          \
  }                                                                                                    \
  VDGS_INLINE void store(Scalar* p, Lanes a) {                                                         \
    VDGS_EACH* reinterpret_cast<Aligned##Lanes##Part*>(p + k * kPartLanes) = a.v[k];                   \
  }                                                                                                    \
  VDGS_INLINE void storeu(Scalar* p, Lanes a) {                                                        \
    VDGS_EACH* reinterpret_cast<Any##Lanes##Part*>(p + k * kPartLanes) = a.v[k];                       \
  }
VDGS_LOADS_AND_STORES(F16, float)
VDGS_LOADS_AND_STORES(I16, int32_t)
#undef VDGS_LOADS_AND_STORES

VDGS_INLINE F16 load_first(const float* p, int count) {
  F16 r = splat(0.0f);
  std::memcpy(&r, p, static_cast<size_t>(count) * sizeof(float));
  return r;
}
VDGS_INLINE void store_first(float* p, int count, F16 a) {
  std::memcpy(p, &a, static_cast<size_t>(count) * sizeof(float));
}

#define VDGS_OPERATOR(Lanes, op)                    \
  VDGS_INLINE Lanes operator op(Lanes a, Lanes b) { \
    VDGS_EACH a.v[k] = a.v[k] op b.v[k];            \
    return a;                                       \
  }
VDGS_OPERATOR(F16, +)
VDGS_OPERATOR(F16, -)
VDGS_OPERATOR(F16, *)
VDGS_OPERATOR(F16, /)
VDGS_OPERATOR(I16, +)
VDGS_OPERATOR(I16, -)
VDGS_OPERATOR(I16, &)
VDGS_OPERATOR(I16, |)
#undef VDGS_OPERATOR

// The compiler contracts these to one instruction where there is one.
VDGS_INLINE F16 fma(F16 a, F16 b, F16 c) {
  VDGS_EACH c.v[k] = a.v[k] * b.v[k] + c.v[k];
  return c;
}
VDGS_INLINE F16 fnma(F16 a, F16 b, F16 c) {
  VDGS_EACH c.v[k] = c.v[k] - a.v[k] * b.v[k];
  return c;
}
VDGS_INLINE F16 min(F16 a, F16 b) {
  VDGS_EACH a.v[k] = part::min(a.v[k], b.v[k]);
  return a;
}
VDGS_INLINE F16 max(F16 a, F16 b) {
  VDGS_EACH a.v[k] = part::max(a.v[k], b.v[k]);
  return a;
}
VDGS_INLINE F16 abs(F16 a) {
  VDGS_EACH a.v[k] = (FloatPart)((IntPart)a.v[k] & 0x7fffffff);
  return a;
}
VDGS_INLINE F16 sqrt(F16 a) {
  VDGS_EACH a.v[k] = part::sqrt(a.v[k]);
  return a;
}

#define VDGS_COMPARISON(name, op)                   \
  VDGS_INLINE M16 name(F16 a, F16 b) {              \
    M16 r;                                          \
    VDGS_EACH r.m[k] = (IntPart)(a.v[k] op b.v[k]); \
    return r;                                       \
  }
VDGS_COMPARISON(lt, <)
VDGS_COMPARISON(le, <=)
VDGS_COMPARISON(gt, >)
VDGS_COMPARISON(ge, >=)
#undef VDGS_COMPARISON

VDGS_INLINE M16 lt(I16 a, I16 b) {
  M16 r;
  VDGS_EACH r.m[k] = a.v[k] < b.v[k];
  return r;
}
VDGS_INLINE F16 select(M16 m, F16 a, F16 b) {
  VDGS_EACH a.v[k] = part::select(m.m[k], a.v[k], b.v[k]);
  return a;
}
VDGS_INLINE F16 zero_unless(M16 m, F16 a) {
  VDGS_EACH a.v[k] = (FloatPart)((IntPart)a.v[k] & m.m[k]);
  return a;
}

template <int n>
VDGS_INLINE I16 shift_left(I16 a) {
  VDGS_EACH a.v[k] = (IntPart)((UintPart)a.v[k] << n);
  return a;
}
template <int n>
VDGS_INLINE I16 shift_right(I16 a) {
  VDGS_EACH a.v[k] = (IntPart)((UintPart)a.v[k] >> n);
  return a;
}
VDGS_INLINE I16 to_int(F16 a) {
  I16 r;
  VDGS_EACH r.v[k] = part::truncate(a.v[k]);
  return r;
}
VDGS_INLINE F16 to_float(I16 a) {
  F16 r;
  VDGS_EACH r.v[k] = __builtin_convertvector(a.v[k], FloatPart);
  return r;
}
VDGS_INLINE I16 bits_of(F16 a) {
  I16 r;
  VDGS_EACH r.v[k] = (IntPart)a.v[k];
  return r;
}
VDGS_INLINE F16 float_of_bits(I16 a) {
  F16 r;
  VDGS_EACH r.v[k] = (FloatPart)a.v[k];
  return r;
}

VDGS_INLINE F16 floor(F16 a) {
#if defined(__AVX2__)
  VDGS_EACH a.v[k] = _mm256_floor_ps(a.v[k]);
  return a;
#else
  // Beyond 2^23 every float is whole already, and the conversion to int would not fit.
  const F16 whole = to_float(to_int(a));
  const F16 down = whole - zero_unless(gt(whole, a), splat(1.0f));
  return select(lt(abs(a), splat(8388608.0f)), down, a);
#endif
}

// Divided: the bits of the processor's estimate (rcpps) differ from maker to maker.
VDGS_INLINE F16 reciprocal(F16 a) { return splat(1.0f) / a; }
VDGS_INLINE F16 rsqrt(F16 a) { return splat(1.0f) / sqrt(a); }

VDGS_INLINE float hsum(F16 a) {
  FloatPart s = a.v[0];
  for (int k = 1; k < kParts; ++k) s += a.v[k];
  float r = s[0];
  for (int i = 1; i < kPartLanes; ++i) r += s[i];
  return r;
}
#if defined(__SSE2__)
namespace part {
VDGS_INLINE __m128 fold(F16 a) {
#if defined(__AVX2__)
  const __m256 s = a.v[0] + a.v[1];
  return _mm_add_ps(_mm256_castps256_ps128(s), _mm256_extractf128_ps(s, 1));
#else
  return (a.v[0] + a.v[1]) + (a.v[2] + a.v[3]);
#endif
}
}  // namespace part
VDGS_INLINE void hsum4(float* out, F16 a, F16 b, F16 c, F16 d) {
  __m128 x = part::fold(a), y = part::fold(b), z = part::fold(c), w = part::fold(d);
  _MM_TRANSPOSE4_PS(x, y, z, w);
  _mm_storeu_ps(out, _mm_add_ps(_mm_add_ps(x, y), _mm_add_ps(z, w)));
}
#else
VDGS_INLINE void hsum4(float* out, F16 a, F16 b, F16 c, F16 d) {
  out[0] = hsum(a), out[1] = hsum(b), out[2] = hsum(c), out[3] = hsum(d);
}
#endif

// 2^a: relative error below 1.2e-7, underflow to 0 (below 2^-126.5), overflow to infinity, NaN stays NaN.
VDGS_INLINE F16 exp2(F16 a) {
  // min and max return their second argument when one is NaN, so NaN passes through.
  const F16 x = min(splat(128.0f), max(splat(-127.0f), a));
  const F16 rounder = splat(12582912.0f);  // 1.5 * 2^23: adding it rounds to the nearest integer
  const F16 whole = (x + rounder) - rounder;
  const F16 f = x - whole;
  F16 p = splat(1.327647196e-03f);
  p = fma(p, f, splat(9.675541503e-03f));
  p = fma(p, f, splat(5.550713275e-02f));
  p = fma(p, f, splat(2.402211972e-01f));
  p = fma(p, f, splat(6.931469671e-01f));
  p = fma(p, f, splat(1.0f));
  return p * float_of_bits(shift_left<23>(to_int(whole) + splat(127)));
}

VDGS_INLINE F16 exp2_bounded(F16 a) {
  const F16 rounder = splat(12582912.0f);  // 1.5 * 2^23: the sum's low bits are the nearest integer
  const F16 rounded = a + rounder;
  const F16 f = a - (rounded - rounder);
  F16 p = splat(1.327647196e-03f);
  p = fma(p, f, splat(9.675541503e-03f));
  p = fma(p, f, splat(5.550713275e-02f));
  p = fma(p, f, splat(2.402211972e-01f));
  p = fma(p, f, splat(6.931469671e-01f));
  p = fma(p, f, splat(1.0f));
  return float_of_bits(bits_of(p) + shift_left<23>(bits_of(rounded)));
}

VDGS_INLINE void load2(const float* p, F16& x, F16& y) {
  alignas(64) float columns[2][16];
  for (int i = 0; i < 16; ++i) columns[0][i] = p[2 * i], columns[1][i] = p[2 * i + 1];
  x = load(columns[0]), y = load(columns[1]);
}
VDGS_INLINE void load3(const float* p, F16& x, F16& y, F16& z) {
  alignas(64) float columns[3][16];
  for (int i = 0; i < 16; ++i)
    columns[0][i] = p[3 * i], columns[1][i] = p[3 * i + 1], columns[2][i] = p[3 * i + 2];
  x = load(columns[0]), y = load(columns[1]), z = load(columns[2]);
}
VDGS_INLINE void store3(float* p, F16 x, F16 y, F16 z) {
  alignas(64) float columns[3][16];
  store(columns[0], x), store(columns[1], y), store(columns[2], z);
  for (int i = 0; i < 16; ++i)
    p[3 * i] = columns[0][i], p[3 * i + 1] = columns[1][i], p[3 * i + 2] = columns[2][i];
}

namespace part {
template <class Lanes, class Scalar>
VDGS_INLINE void compress_store(Scalar* p, unsigned chosen, const Lanes& a) {
  Scalar lanes[16];
  std::memcpy(lanes, &a, 64);
  for (; chosen; chosen &= chosen - 1) *p++ = lanes[__builtin_ctz(chosen)];
}
}  // namespace part
VDGS_INLINE void compress_store(float* p, M16 m, F16 a) { part::compress_store(p, bits(m), a); }
VDGS_INLINE void compress_store(int32_t* p, M16 m, I16 a) { part::compress_store(p, bits(m), a); }

// Quads are the 128-bit quarters of the sixteen lanes, in whatever parts they are held.
VDGS_INLINE F16 load_quads(const float* p, ptrdiff_t stride) {
  F16 r;
#if defined(__AVX2__)
  r.v[0] = _mm256_set_m128(_mm_loadu_ps(p + stride), _mm_loadu_ps(p));
  r.v[1] = _mm256_set_m128(_mm_loadu_ps(p + 3 * stride), _mm_loadu_ps(p + 2 * stride));
#else
  for (int i = 0; i < 4; ++i) std::memcpy(&r.v[i], p + i * stride, 16);
#endif
  return r;
}
VDGS_INLINE void store_quads(float* p, ptrdiff_t stride, F16 a) {
#if defined(__AVX2__)
  _mm256_storeu2_m128(p + stride, p, a.v[0]);
  _mm256_storeu2_m128(p + 3 * stride, p + 2 * stride, a.v[1]);
#else
  for (int i = 0; i < 4; ++i) std::memcpy(p + i * stride, &a.v[i], 16);
#endif
}

VDGS_INLINE uint64_t bit_column(const uint16_t* masks, int bit) {
  uint64_t column = 0;
#if defined(__SSE2__)
  const __m128i shift = _mm_cvtsi32_si128(15 - bit);  // brings the bit to the sign, which packs keeps
  for (int q = 0; q < 4; ++q) {
    const __m128i* eight = reinterpret_cast<const __m128i*>(masks + 16 * q);
    const __m128i low = _mm_sll_epi16(_mm_load_si128(eight), shift);
    const __m128i high = _mm_sll_epi16(_mm_load_si128(eight + 1), shift);
    const unsigned sixteen = static_cast<unsigned>(_mm_movemask_epi8(_mm_packs_epi16(low, high)));
    column |= static_cast<uint64_t>(sixteen) << (16 * q);
  }
#else
  for (int i = 0; i < 64; ++i) column |= static_cast<uint64_t>((masks[i] >> bit) & 1u) << i;
#endif
  return column;
}
VDGS_INLINE void set_bit_column(uint16_t* masks, int bit, uint64_t column) {
  typedef uint16_t Eight __attribute__((vector_size(16)));
  const Eight weight = {1, 2, 4, 8, 16, 32, 64, 128};
  const Eight wanted = Eight{} + static_cast<uint16_t>(1u << bit);
  for (int q = 0; q < 8; ++q) {
    Eight eight;
    std::memcpy(&eight, masks + 8 * q, 16);
    const Eight chosen =
        (Eight)(((Eight{} + static_cast<uint16_t>((column >> (8 * q)) & 255)) & weight) != 0);
    eight |= chosen & wanted;
    std::memcpy(masks + 8 * q, &eight, 16);
  }
}

#undef VDGS_EACH

}  // namespace vdgs
