// SIMD vectors of floats and integers, as wide as the instruction set; base/lanes.h has doubles with the same function
// names. For files that are compiled once per instruction set, with -DLINPRIM_ISA=<name> -DLINPRIM_ISA_<NAME>=1.
#pragma once

#include <cmath>
#include <cstdint>
#if defined(LINPRIM_ISA_V3) || defined(LINPRIM_ISA_V4)
#include <immintrin.h>
#endif

namespace linprim {
namespace LINPRIM_ISA {
namespace {

#if defined(LINPRIM_ISA_V4)
constexpr int kWide = 16;
#elif defined(LINPRIM_ISA_V3)
constexpr int kWide = 8;
#elif defined(LINPRIM_ISA_SCALAR)
constexpr int kWide = 1;
#else
constexpr int kWide = 4;
#endif
typedef float F __attribute__((vector_size(4 * kWide)));
typedef int32_t I __attribute__((vector_size(4 * kWide)));

inline F splat(float x) { return x - F{}; }
inline F vmin(F a, F b) { return a < b ? a : b; }
inline F vmax(F a, F b) { return a > b ? a : b; }

inline I gather(const uint32_t* base, I at) {
#if defined(LINPRIM_ISA_V4)
  return (I)_mm512_i32gather_epi32((__m512i)at, (const int*)base, 4);
#elif defined(LINPRIM_ISA_V3)
  return (I)_mm256_i32gather_epi32((const int*)base, (__m256i)at, 4);
#else
  I r;
  for (int l = 0; l < kWide; ++l) r[l] = int32_t(base[at[l]]);
  return r;
#endif
}

inline F vsqrt(F a) {
#if defined(LINPRIM_ISA_V4)
  return (F)_mm512_sqrt_ps((__m512)a);
#elif defined(LINPRIM_ISA_V3)
  return (F)_mm256_sqrt_ps((__m256)a);
#else
  for (int l = 0; l < kWide; ++l) a[l] = std::sqrt(a[l]);
  return a;
#endif
}

}  // namespace
}  // namespace LINPRIM_ISA
}  // namespace linprim
