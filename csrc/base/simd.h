// SIMD vectors of W floats (or doubles) at the machine's native width, for code that is compiled once per instruction
// set.
//
// Included only by files that are built per instruction set. Everything is in namespace linprim::LINPRIM_ISA, so that
// no inline function built for one instruction set can be linked into the code of another.
//
//   Vec<T, W>   W lanes of T        + - * fma min max rcp exp_neg
//   Mask<T, W>  W booleans          & | bits all
//   Index<T, W> W small integers    select lookup8 equal is_face
//
// Only operations whose result IEEE 754 defines are used: rcp is a correctly rounded division. Hardware estimates of
// reciprocals and reciprocal square roots differ between processor makers, and would change every trained bit.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#if defined(LINPRIM_ISA_V3) || defined(LINPRIM_ISA_V4)
#include <immintrin.h>
#elif defined(LINPRIM_ISA_V2)
#include <nmmintrin.h>
#endif

namespace linprim::LINPRIM_ISA {

// ---- W = 1: the oracle of the vector paths --------------------------------------------------------------------------

template <class T, int W>
struct Mask;
template <class T, int W>
struct Vec;

template <class T>
struct Mask<T, 1> {
  bool m;
  static Mask all(bool on) { return {on}; }
  friend Mask operator&(Mask a, Mask b) { return {a.m && b.m}; }
  friend Mask operator|(Mask a, Mask b) { return {a.m || b.m}; }
  unsigned bits() const { return m ? 1u : 0u; }
};

template <class T>
struct Vec<T, 1> {
  T v;
  static Vec load(const T* p) { return {*p}; }
  static Vec set(T x) { return {x}; }
  void store(T* p) const { *p = v; }
  friend Vec operator+(Vec a, Vec b) { return {a.v + b.v}; }
  friend Vec operator-(Vec a, Vec b) { return {a.v - b.v}; }
  friend Vec operator*(Vec a, Vec b) { return {a.v * b.v}; }
  friend Mask<T, 1> operator<(Vec a, Vec b) { return {a.v < b.v}; }
  friend Mask<T, 1> operator>=(Vec a, Vec b) { return {a.v >= b.v}; }
};
template <class T>
inline Vec<T, 1> fma(Vec<T, 1> a, Vec<T, 1> b, Vec<T, 1> c) {
  return {a.v * b.v + c.v};
}
template <class T>
inline Vec<T, 1> min(Vec<T, 1> a, Vec<T, 1> b) {
  return {a.v < b.v ? a.v : b.v};
}
template <class T>
inline Vec<T, 1> max(Vec<T, 1> a, Vec<T, 1> b) {
  return {a.v > b.v ? a.v : b.v};
}
template <class T>
inline Vec<T, 1> select(Mask<T, 1> m, Vec<T, 1> a, Vec<T, 1> b) {
  return m.m ? a : b;
}
template <class T>
inline Vec<T, 1> rcp(Vec<T, 1> a) {
  return {T(1) / a.v};
}
template <class T>
inline Vec<T, 1> sqrt(Vec<T, 1> a) {
  return {std::sqrt(a.v)};
}
template <class T>
inline Vec<T, 1> log(Vec<T, 1> a) {
  return {std::log(a.v)};
}
template <class T>
inline T sum(Vec<T, 1> a) {
  return a.v;
}
template <class T>
inline T max_lane(Vec<T, 1> a) {
  return a.v;
}
// alpha = 1 - exp(-x) to full relative accuracy and transmittance = exp(-x), for x >= 0.
template <class T>
inline void exp_neg(Vec<T, 1> x, Vec<T, 1>& alpha, Vec<T, 1>& transmittance) {
  alpha.v = -std::expm1(-x.v);
  transmittance.v = std::exp(-x.v);
}
// An integer per lane, updated along with a min or max to record which face gave it.
template <class T, int W>
struct Index;
template <class T>
struct Index<T, 1> {
  int v;
  static Index set(int x) { return {x}; }
};
template <class T>
inline Index<T, 1> select(Mask<T, 1> m, Index<T, 1> a, Index<T, 1> b) {
  return m.m ? a : b;
}
// table[index] per lane; the table has 8 entries.
template <class T>
inline Vec<T, 1> lookup8(const T* table, Index<T, 1> i) {
  return {table[i.v & 7]};
}
template <class T>
inline Mask<T, 1> equal(Index<T, 1> i, int x) {
  return {i.v == x};
}
// index < 8: a face, not the near plane.
template <class T>
inline Mask<T, 1> is_face(Index<T, 1> i) {
  return {i.v < 8};
}

// ---- W = 4 (SSE4, NEON) through the compiler's vector extensions
// -------------------------------------------------------

template <>
struct Mask<float, 4> {
  typedef int32_t native __attribute__((vector_size(16)));
  native m;
  static Mask all(bool on) {
    const int32_t x = -int32_t(on);
    return {native{x, x, x, x}};
  }
  friend Mask operator&(Mask a, Mask b) { return {a.m & b.m}; }
  friend Mask operator|(Mask a, Mask b) { return {a.m | b.m}; }
  unsigned bits() const {
#if defined(LINPRIM_ISA_V2)
    return unsigned(_mm_movemask_ps((__m128)m));
#else
    return (m[0] & 1u) | (m[1] & 2u) | (m[2] & 4u) | (m[3] & 8u);
#endif
  }
};
template <>
struct Vec<float, 4> {
  typedef float native __attribute__((vector_size(16)));
  native v;
  static Vec load(const float* p) {
    Vec r;
    std::memcpy(&r.v, p, 16);
    return r;
  }
  static Vec set(float x) { return {native{x, x, x, x}}; }
  void store(float* p) const { std::memcpy(p, &v, 16); }
  friend Vec operator+(Vec a, Vec b) { return {a.v + b.v}; }
  friend Vec operator-(Vec a, Vec b) { return {a.v - b.v}; }
  friend Vec operator*(Vec a, Vec b) { return {a.v * b.v}; }
  friend Mask<float, 4> operator<(Vec a, Vec b) { return {a.v < b.v}; }
  friend Mask<float, 4> operator>=(Vec a, Vec b) { return {a.v >= b.v}; }
};
using F4 = Vec<float, 4>;
using M4 = Mask<float, 4>;
inline F4 fma(F4 a, F4 b, F4 c) { return {a.v * b.v + c.v}; }
inline F4 min(F4 a, F4 b) { return {a.v < b.v ? a.v : b.v}; }
inline F4 max(F4 a, F4 b) { return {a.v > b.v ? a.v : b.v}; }
inline F4 select(M4 m, F4 a, F4 b) { return {m.m ? a.v : b.v}; }
inline F4 rcp(F4 a) { return {1.0f / a.v}; }
inline F4 sqrt(F4 a) {
  for (int i = 0; i < 4; ++i) a.v[i] = std::sqrt(a.v[i]);
  return a;
}
inline float sum(F4 a) { return (a.v[0] + a.v[2]) + (a.v[1] + a.v[3]); }
inline float max_lane(F4 a) { return std::fmax(std::fmax(a.v[0], a.v[2]), std::fmax(a.v[1], a.v[3])); }
inline F4 log(F4 a) {
  for (int i = 0; i < 4; ++i) a.v[i] = std::log(a.v[i]);
  return a;
}
template <>
struct Index<float, 4> {
  M4::native v;
  static Index set(int x) { return {M4::native{x, x, x, x}}; }
};
inline Index<float, 4> select(M4 m, Index<float, 4> a, Index<float, 4> b) { return {m.m ? a.v : b.v}; }
inline F4 lookup8(const float* t, Index<float, 4> i) {
  return {F4::native{t[i.v[0] & 7], t[i.v[1] & 7], t[i.v[2] & 7], t[i.v[3] & 7]}};
}
inline M4 is_face(Index<float, 4> i) { return {i.v < 8}; }
inline M4 equal(Index<float, 4> i, int x) { return {i.v == x}; }
inline F4 round_to_int(F4 a) {
  const float shift = 12582912.0f;  // 1.5 * 2^23: adding it rounds to the nearest integer
  return {(a.v + shift) - shift};
}
inline F4 exp2_int(F4 n) {
  M4::native i = __builtin_convertvector(n.v, M4::native);
  i = (i + 127) << 23;
  F4 r;
  std::memcpy(&r.v, &i, 16);
  return r;
}

// ---- W = 8 (AVX2, FMA)
// --------------------------------------------------------------------------------------------------

#if defined(LINPRIM_ISA_V3)
template <>
struct Mask<float, 8> {
  __m256 m;
  static Mask all(bool on) { return {_mm256_castsi256_ps(_mm256_set1_epi32(-int32_t(on)))}; }
  friend Mask operator&(Mask a, Mask b) { return {_mm256_and_ps(a.m, b.m)}; }
  friend Mask operator|(Mask a, Mask b) { return {_mm256_or_ps(a.m, b.m)}; }
  unsigned bits() const { return unsigned(_mm256_movemask_ps(m)); }
};
template <>
struct Vec<float, 8> {
  __m256 v;
  static Vec load(const float* p) { return {_mm256_loadu_ps(p)}; }
  static Vec set(float x) { return {_mm256_set1_ps(x)}; }
  void store(float* p) const { _mm256_storeu_ps(p, v); }
  friend Vec operator+(Vec a, Vec b) { return {_mm256_add_ps(a.v, b.v)}; }
  friend Vec operator-(Vec a, Vec b) { return {_mm256_sub_ps(a.v, b.v)}; }
  friend Vec operator*(Vec a, Vec b) { return {_mm256_mul_ps(a.v, b.v)}; }
  friend Mask<float, 8> operator<(Vec a, Vec b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_LT_OQ)}; }
  friend Mask<float, 8> operator>=(Vec a, Vec b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_GE_OQ)}; }
};
using F8 = Vec<float, 8>;
using M8 = Mask<float, 8>;
inline F8 fma(F8 a, F8 b, F8 c) { return {_mm256_fmadd_ps(a.v, b.v, c.v)}; }
inline F8 min(F8 a, F8 b) { return {_mm256_min_ps(a.v, b.v)}; }
inline F8 max(F8 a, F8 b) { return {_mm256_max_ps(a.v, b.v)}; }
inline F8 select(M8 m, F8 a, F8 b) { return {_mm256_blendv_ps(b.v, a.v, m.m)}; }
inline F8 rcp(F8 a) { return {_mm256_div_ps(_mm256_set1_ps(1.0f), a.v)}; }
inline F8 sqrt(F8 a) { return {_mm256_sqrt_ps(a.v)}; }
inline float sum(F8 a) {
  const __m128 h = _mm_add_ps(_mm256_castps256_ps128(a.v), _mm256_extractf128_ps(a.v, 1));
  const __m128 q = _mm_add_ps(h, _mm_movehl_ps(h, h));
  return _mm_cvtss_f32(_mm_add_ss(q, _mm_movehdup_ps(q)));
}
inline float max_lane(F8 a) {
  const __m128 h = _mm_max_ps(_mm256_castps256_ps128(a.v), _mm256_extractf128_ps(a.v, 1));
  const __m128 q = _mm_max_ps(h, _mm_movehl_ps(h, h));
  return _mm_cvtss_f32(_mm_max_ss(q, _mm_movehdup_ps(q)));
}
inline F8 log(F8 a) {
  alignas(32) float x[8];
  a.store(x);
  for (float& y : x) y = std::log(y);
  return F8::load(x);
}
template <>
struct Index<float, 8> {
  __m256i v;
  static Index set(int x) { return {_mm256_set1_epi32(x)}; }
};
inline Index<float, 8> select(M8 m, Index<float, 8> a, Index<float, 8> b) {
  return {_mm256_blendv_epi8(b.v, a.v, _mm256_castps_si256(m.m))};
}
inline F8 lookup8(const float* t, Index<float, 8> i) { return {_mm256_permutevar8x32_ps(_mm256_loadu_ps(t), i.v)}; }
inline M8 equal(Index<float, 8> i, int x) {
  return {_mm256_castsi256_ps(_mm256_cmpeq_epi32(i.v, _mm256_set1_epi32(x)))};
}
inline M8 is_face(Index<float, 8> i) { return {_mm256_castsi256_ps(_mm256_cmpgt_epi32(_mm256_set1_epi32(8), i.v))}; }
inline F8 round_to_int(F8 a) { return {_mm256_round_ps(a.v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC)}; }
inline F8 exp2_int(F8 n) {
  const __m256i i = _mm256_add_epi32(_mm256_cvtps_epi32(n.v), _mm256_set1_epi32(127));
  return {_mm256_castsi256_ps(_mm256_slli_epi32(i, 23))};
}
#endif

// ---- W = 16 (AVX-512)
// ---------------------------------------------------------------------------------------------------

#if defined(LINPRIM_ISA_V4)
template <>
struct Mask<float, 16> {
  __mmask16 m;
  static Mask all(bool on) { return {__mmask16(-int32_t(on))}; }
  friend Mask operator&(Mask a, Mask b) { return {__mmask16(a.m & b.m)}; }
  friend Mask operator|(Mask a, Mask b) { return {__mmask16(a.m | b.m)}; }
  unsigned bits() const { return unsigned(m); }
};
template <>
struct Vec<float, 16> {
  __m512 v;
  static Vec load(const float* p) { return {_mm512_loadu_ps(p)}; }
  static Vec set(float x) { return {_mm512_set1_ps(x)}; }
  void store(float* p) const { _mm512_storeu_ps(p, v); }
  friend Vec operator+(Vec a, Vec b) { return {_mm512_add_ps(a.v, b.v)}; }
  friend Vec operator-(Vec a, Vec b) { return {_mm512_sub_ps(a.v, b.v)}; }
  friend Vec operator*(Vec a, Vec b) { return {_mm512_mul_ps(a.v, b.v)}; }
  friend Mask<float, 16> operator<(Vec a, Vec b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LT_OQ)}; }
  friend Mask<float, 16> operator>=(Vec a, Vec b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ)}; }
};
using F16 = Vec<float, 16>;
using M16 = Mask<float, 16>;
inline F16 fma(F16 a, F16 b, F16 c) { return {_mm512_fmadd_ps(a.v, b.v, c.v)}; }
inline F16 min(F16 a, F16 b) { return {_mm512_min_ps(a.v, b.v)}; }
inline F16 max(F16 a, F16 b) { return {_mm512_max_ps(a.v, b.v)}; }
inline F16 select(M16 m, F16 a, F16 b) { return {_mm512_mask_blend_ps(m.m, b.v, a.v)}; }
inline F16 rcp(F16 a) { return {_mm512_div_ps(_mm512_set1_ps(1.0f), a.v)}; }
inline F16 sqrt(F16 a) { return {_mm512_sqrt_ps(a.v)}; }
inline float sum(F16 a) { return _mm512_reduce_add_ps(a.v); }
inline float max_lane(F16 a) { return _mm512_reduce_max_ps(a.v); }
inline F16 log(F16 a) {
  alignas(64) float x[16];
  a.store(x);
  for (float& y : x) y = std::log(y);
  return F16::load(x);
}
template <>
struct Index<float, 16> {
  __m512i v;
  static Index set(int x) { return {_mm512_set1_epi32(x)}; }
};
inline Index<float, 16> select(M16 m, Index<float, 16> a, Index<float, 16> b) {
  return {_mm512_mask_blend_epi32(m.m, b.v, a.v)};
}
inline F16 lookup8(const float* t, Index<float, 16> i) {
  return {_mm512_permutexvar_ps(i.v, _mm512_broadcast_f32x8(_mm256_loadu_ps(t)))};
}
inline M16 equal(Index<float, 16> i, int x) { return {_mm512_cmpeq_epi32_mask(i.v, _mm512_set1_epi32(x))}; }
inline M16 is_face(Index<float, 16> i) { return {_mm512_cmplt_epi32_mask(i.v, _mm512_set1_epi32(8))}; }
inline F16 round_to_int(F16 a) { return {_mm512_roundscale_ps(a.v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC)}; }
inline F16 exp2_int(F16 n) { return {_mm512_scalef_ps(_mm512_set1_ps(1.0f), n.v)}; }
#endif

// alpha = 1 - exp(-x) and transmittance = exp(-x) for x >= 0, both to about 3e-7 relative (alpha also for tiny x).
//
// exp(-x) = 2^n (1 + f(r)) with n = round(-x / ln 2), |r| <= ln(2)/2 and f(r) = exp(r) - 1, a Taylor polynomial of
// degree 7 whose remainder there is below 6e-9. With s = 2^n: 1 - exp(-x) = (1 - s) - s f, exact where s = 1.
template <class V>
inline void exp_neg(V x, V& alpha, V& transmittance) {
  const V limited = min(x, V::set(87.0f));  // exp(-87) = 1.6e-38 is the smallest normal float
  const V n = round_to_int(limited * V::set(-1.44269504088896341f));
  V r = fma(n, V::set(-0.693145751953125f), V::set(0.0f) - limited);  // ln 2 in two parts
  r = fma(n, V::set(-1.42860682030941723e-6f), r);
  const V r2 = r * r;  // the polynomial in pairs of terms: half the chain of Horner's scheme
  const V low = fma(r, V::set(1.0f / 6), V::set(0.5f)), middle = fma(r, V::set(1.0f / 120), V::set(1.0f / 24));
  const V high = fma(r, V::set(1.0f / 5040), V::set(1.0f / 720));
  const V f = fma(fma(fma(high, r2, middle), r2, low), r2, r);
  const V s = exp2_int(n);
  const V sf = s * f;
  transmittance = s + sf;
  alpha = (V::set(1.0f) - s) - sf;
}

// Returns bit `bit` of up to 32 masks, as the bits of the result.
inline uint32_t column(const uint32_t* masks, int count, int bit) {
#if defined(LINPRIM_ISA_V4)
  const __m512i wanted = _mm512_set1_epi32(1 << bit);
  const uint32_t all = count == 32 ? ~0u : (1u << count) - 1;
  const __mmask16 low = __mmask16(all), high = __mmask16(all >> 16);
  return uint32_t(_mm512_mask_test_epi32_mask(low, _mm512_maskz_loadu_epi32(low, masks), wanted)) |
         uint32_t(_mm512_mask_test_epi32_mask(high, _mm512_maskz_loadu_epi32(high, masks + 16), wanted)) << 16;
#else
  uint32_t result = 0;
  for (int i = 0; i < count; ++i) result |= (masks[i] >> bit & 1u) << i;
  return result;
#endif
}

}  // namespace linprim::LINPRIM_ISA
