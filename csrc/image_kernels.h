// L1 + D-SSIM with its gradient, and Adam: loops over rows and parameters that the compiler vectorises.
//
// SSIM as in 3DGS: 11x11 Gaussian window of sigma 1.5, zeros beyond the border, C1 = 0.01^2, C2 = 0.03^2, mean over pixels.
// Included by kernels.cpp only.
#pragma once

#include <algorithm>
#include <cmath>

#include "kernels.h"

namespace linprim::LINPRIM_ISA {

constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
// exp(-i^2 / (2 sigma^2)) / sum for i = 0..5, sigma 1.5: half of the symmetric window.
constexpr float kWindow[kSsimRadius + 1] = {0.26601171493530273f, 0.21300552785396576f, 0.10936068743467331f,
                                            0.03600077331066132f, 0.00759875820949674f, 0.0010283800877257609f};

// out[x] = window * in around x; `in` is padded by kSsimRadius zeros on both sides.
inline void blur_row(const float* __restrict in, float* __restrict out, int width) {
  for (int x = 0; x < width; ++x) {
    const float* c = in + x + kSsimRadius;
    float s = kWindow[0] * c[0];
    for (int k = 1; k <= kSsimRadius; ++k) s += kWindow[k] * (c[-k] + c[k]);
    out[x] = s;
  }
}

inline void blur_column(const float* const* rows, float* __restrict out, int width) {
  const float *r0 = rows[0], *r1 = rows[1], *r2 = rows[2], *r3 = rows[3], *r4 = rows[4], *r5 = rows[5], *r6 = rows[6], *r7 = rows[7],
              *r8 = rows[8], *r9 = rows[9], *r10 = rows[10];
  for (int x = 0; x < width; ++x)
    out[x] = kWindow[0] * r5[x] + kWindow[1] * (r4[x] + r6[x]) + kWindow[2] * (r3[x] + r7[x]) + kWindow[3] * (r2[x] + r8[x]) +
             kWindow[4] * (r1[x] + r9[x]) + kWindow[5] * (r0[x] + r10[x]);
}

// Blurs kMaps maps over rows [begin, end): `fill(row, out)` writes the padded rows of the maps, `use(row, blurred)` takes the
// result. Rows outside [0, height) are zero. `buffer` holds photometric_buffer_size(width) floats.
template <int kMaps, class Fill, class Use>
inline void blur_strip(int width, int height, int begin, int end, float* buffer, Fill fill, Use use) {
  constexpr int kSpan = 2 * kSsimRadius + 1;
  const int pitch = width + 2 * kSsimRadius;
  float* padded[kMaps];
  float* ring[kMaps];
  float* blurred[kMaps];
  float* next = buffer;
  for (int m = 0; m < kMaps; ++m) {
    padded[m] = next, next += pitch;
    ring[m] = next, next += kSpan * width;
    blurred[m] = next, next += width;
    std::fill(padded[m], padded[m] + kSsimRadius, 0.0f);
    std::fill(padded[m] + kSsimRadius + width, padded[m] + pitch, 0.0f);
  }
  float* inner[kMaps];
  for (int m = 0; m < kMaps; ++m) inner[m] = padded[m] + kSsimRadius;
  for (int row = begin - kSsimRadius; row < end + kSsimRadius; ++row) {
    const int at = (row + kSpan) % kSpan;
    if (row < 0 || row >= height) {
      for (int m = 0; m < kMaps; ++m) std::fill(ring[m] + at * width, ring[m] + (at + 1) * width, 0.0f);
    } else {
      fill(row, inner);
      for (int m = 0; m < kMaps; ++m) blur_row(padded[m], ring[m] + at * width, width);
    }
    const int center = row - kSsimRadius;
    if (center < begin) continue;
    for (int m = 0; m < kMaps; ++m) {
      const float* rows[kSpan];
      for (int k = 0; k < kSpan; ++k) rows[k] = ring[m] + (center - kSsimRadius + k + kSpan) % kSpan * width;
      blur_column(rows, blurred[m], width);
    }
    use(center, blurred);
  }
}

inline void photometric_maps(const PhotometricParams& P, int channel, int begin, int end, float* buffer, double* l1, double* ssim) {
  const int width = P.width, height = P.height;
  const int64_t plane = int64_t(width) * height;
  const float *image = P.image + channel * plane, *target = P.target + channel * plane;
  float* maps[3];
  for (int m = 0; m < 3; ++m) maps[m] = P.scratch + (3 * channel + m) * plane;
  blur_strip<5>(
      width, height, begin, end, buffer,
      [&](int row, float* const* out) {
        const float *a = image + int64_t(row) * width, *b = target + int64_t(row) * width;
        float *__restrict o0 = out[0], *__restrict o1 = out[1], *__restrict o2 = out[2], *__restrict o3 = out[3], *__restrict o4 = out[4];
        for (int x = 0; x < width; ++x) o0[x] = a[x], o1[x] = b[x], o2[x] = a[x] * a[x], o3[x] = b[x] * b[x], o4[x] = a[x] * b[x];
      },
      [&](int row, float* const* blurred) {
        const float *a = image + int64_t(row) * width, *b = target + int64_t(row) * width;
        const float* weight = P.weight ? P.weight + int64_t(row) * width : nullptr;
        float *__restrict d_mean = maps[0] + int64_t(row) * width, *__restrict d_square = maps[1] + int64_t(row) * width,
              *__restrict d_cross = maps[2] + int64_t(row) * width;
        const float *m1 = blurred[0], *m2 = blurred[1], *xx = blurred[2], *yy = blurred[3], *xy = blurred[4];
        double sum_l1 = 0, sum_ssim = 0;
        constexpr int kChunk = 64;  // float partial sums of short runs, then double
        for (int x0 = 0; x0 < width; x0 += kChunk) {
          float part_l1[kChunk], part_ssim[kChunk];
          const int n = std::min(kChunk, width - x0);
          for (int i = 0; i < n; ++i) {
            const int x = x0 + i;
            const float w = weight ? weight[x] : 1.0f, u = m1[x], v = m2[x];
            const float a1 = 2 * u * v + kC1, a2 = 2 * (xy[x] - u * v) + kC2;
            const float b1 = u * u + v * v + kC1, b2 = (xx[x] - u * u) + (yy[x] - v * v) + kC2;
            const float inverse = 1.0f / (b1 * b2), s = a1 * a2 * inverse;
            part_l1[i] = w * std::fabs(a[x] - b[x]);
            part_ssim[i] = w * s;
            d_mean[x] = w * (2 * v * (a2 - a1) * inverse + 2 * u * s * (b1 - b2) * inverse);
            d_square[x] = -w * s * b1 * inverse;
            d_cross[x] = w * 2 * a1 * inverse;
          }
          for (int i = 0; i < n; ++i) sum_l1 += part_l1[i], sum_ssim += part_ssim[i];
        }
        l1[row] = sum_l1, ssim[row] = sum_ssim;
      });
}

// Adjoint of photometric_maps for rows [begin, end) of a channel: the window is symmetric and zeros lie beyond the border, so
// the adjoint of the blur is the blur.
inline void photometric_gradient(const PhotometricParams& P, int channel, int begin, int end, float* buffer) {
  const int width = P.width, height = P.height;
  const int64_t plane = int64_t(width) * height;
  const float *image = P.image + channel * plane, *target = P.target + channel * plane;
  const float l1_scale = float((1.0 - P.dssim) / P.weight_sum), ssim_scale = float(-P.dssim / P.weight_sum);
  blur_strip<3>(
      width, height, begin, end, buffer,
      [&](int row, float* const* out) {
        for (int m = 0; m < 3; ++m) std::copy_n(P.scratch + (3 * channel + m) * plane + int64_t(row) * width, width, out[m]);
      },
      [&](int row, float* const* blurred) {
        const float *a = image + int64_t(row) * width, *b = target + int64_t(row) * width;
        const float* weight = P.weight ? P.weight + int64_t(row) * width : nullptr;
        float* __restrict out = P.gradient + channel * plane + int64_t(row) * width;
        const float *d_mean = blurred[0], *d_square = blurred[1], *d_cross = blurred[2];
        for (int x = 0; x < width; ++x) {
          const float w = weight ? weight[x] : 1.0f, d = a[x] - b[x];
          const float sign = d > 0 ? w : d < 0 ? -w : 0.0f;
          out[x] = l1_scale * sign + ssim_scale * (d_mean[x] + 2 * a[x] * d_square[x] + b[x] * d_cross[x]);
        }
      });
}

// Adam with bias correction (Kingma and Ba 2015, algorithm 1) on elements [begin, end).
inline void adam(const AdamParams& P, int64_t begin, int64_t end) {
  float *__restrict value = P.value, *__restrict first = P.first, *__restrict second = P.second;
  const float* __restrict gradient = P.gradient;
  const float step = P.rate / P.correction1, root = 1.0f / std::sqrt(P.correction2);
  for (int64_t i = begin; i < end; ++i) {
    const float g = gradient[i];
    first[i] = P.beta1 * first[i] + (1 - P.beta1) * g;
    second[i] = P.beta2 * second[i] + (1 - P.beta2) * g * g;
    value[i] -= step * first[i] / (std::sqrt(second[i]) * root + P.epsilon);
  }
}

}  // namespace linprim::LINPRIM_ISA
