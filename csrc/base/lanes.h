// SIMD lanes in double precision for the per-primitive stages, which process several primitives at a time, and the
// transposition of their results to rows.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#include "base/types.h"
#include "base/simd.h"

namespace linprim::LINPRIM_ISA {

#if defined(LINPRIM_ISA_V4)
constexpr int kLanes = 8;
#elif defined(LINPRIM_ISA_V3)
constexpr int kLanes = 4;
#elif defined(LINPRIM_ISA_SCALAR)
constexpr int kLanes = 1;
#else
constexpr int kLanes = 2;
#endif
typedef double D __attribute__((vector_size(8 * kLanes)));
typedef int64_t B __attribute__((vector_size(8 * kLanes)));  // result of comparing D: all ones or 0 per lane

inline D splat(double x) { return x - D{}; }
inline D vmin(D a, D b) { return a < b ? a : b; }
inline D vmax(D a, D b) { return a > b ? a : b; }
inline D vabs(D a) { return a < 0.0 ? -a : a; }
inline D vsqrt(D a) {
#if defined(LINPRIM_ISA_V4)
  return (D)_mm512_sqrt_pd((__m512d)a);
#elif defined(LINPRIM_ISA_V3)
  return (D)_mm256_sqrt_pd((__m256d)a);
#else
  for (int l = 0; l < kLanes; ++l) a[l] = std::sqrt(a[l]);
  return a;
#endif
}
inline D dot(const D a[3], const D b[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline bool any(B m) {
  int64_t bits = 0;
  for (int l = 0; l < kLanes; ++l) bits |= m[l];
  return bits != 0;
}
// Largest integer <= x and smallest >= x, for |x| < 2^62.
inline B floor_of(D x) {
  const B i = __builtin_convertvector(x, B);
  return i + (B)(__builtin_convertvector(i, D) > x);
}
inline B ceil_of(D x) {
  const B i = __builtin_convertvector(x, B);
  return i - (B)(__builtin_convertvector(i, D) < x);
}
inline D clamp(D x, double low, double high) { return vmin(vmax(x, splat(low)), splat(high)); }

// Loads base[rows[l] * stride] into each lane l.
template <class Real>
inline D gather(const Real* base, int64_t stride, const int64_t* rows) {
  D r;
  for (int l = 0; l < kLanes; ++l) r[l] = double(base[rows[l] * stride]);
  return r;
}

// Transposes lanes to rows: first[l * stride + i] = values[i][l] for i < count and l < lanes.
template <class Real>
inline void to_rows(Real* first, int64_t stride, const D* values, int count, int lanes) {
  int done = 0;
#if defined(LINPRIM_ISA_V4)
  if constexpr (sizeof(Real) == 4)
    for (; done + 8 <= count; done += 8) {
      __m256 r[8], s[8];
      for (int i = 0; i < 8; ++i) r[i] = _mm512_cvtpd_ps((__m512d)values[done + i]);
      for (int i = 0; i < 8; i += 2)
        s[i] = _mm256_unpacklo_ps(r[i], r[i + 1]), s[i + 1] = _mm256_unpackhi_ps(r[i], r[i + 1]);
      for (int i = 0; i < 8; i += 4) {
        r[i] = _mm256_shuffle_ps(s[i], s[i + 2], 0x44), r[i + 1] = _mm256_shuffle_ps(s[i], s[i + 2], 0xee);
        r[i + 2] = _mm256_shuffle_ps(s[i + 1], s[i + 3], 0x44), r[i + 3] = _mm256_shuffle_ps(s[i + 1], s[i + 3], 0xee);
      }
      for (int i = 0; i < 4; ++i)
        s[i] = _mm256_permute2f128_ps(r[i], r[4 + i], 0x20), s[4 + i] = _mm256_permute2f128_ps(r[i], r[4 + i], 0x31);
      for (int l = 0; l < lanes; ++l) _mm256_storeu_ps(first + l * stride + done, s[l]);
    }
#elif defined(LINPRIM_ISA_V3)
  if constexpr (sizeof(Real) == 4)
    for (; done + 4 <= count; done += 4) {
      __m128 r[4];
      for (int i = 0; i < 4; ++i) r[i] = _mm256_cvtpd_ps((__m256d)values[done + i]);
      _MM_TRANSPOSE4_PS(r[0], r[1], r[2], r[3]);
      for (int l = 0; l < lanes; ++l) _mm_storeu_ps(first + l * stride + done, r[l]);
    }
#endif
  for (; done < count; ++done)
    for (int l = 0; l < lanes; ++l) first[l * stride + done] = Real(values[done][l]);
}

}  // namespace linprim::LINPRIM_ISA
