// L1 + D-SSIM with its gradient, and Adam: loops over rows and parameters that the compiler vectorises.
//
// SSIM as in 3DGS: 11x11 Gaussian window of sigma 1.5, zeros beyond the border, C1 = 0.01^2, C2 = 0.03^2, mean over pixels.
// Included by kernels.cpp only.
#pragma once

#include <algorithm>
#include <cmath>

#include "kernels.h"
#include "simd.h"

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

// A blur in two halves over a stream of rows: `push` blurs a row of each of kMaps maps along x, `column` gives the maps blurred both
// ways once the row kSsimRadius further down has been pushed. Rows outside the image are pushed as zeros.
template <int kMaps>
struct RowBlur {
  static constexpr int kSpan = 2 * kSsimRadius + 1;
  int width;
  float* padded[kMaps];   // input row with kSsimRadius zeros on both sides
  float* ring[kMaps];     // kSpan rows
  float* blurred[kMaps];  // output row

  // Takes its rows from `memory`, and returns where they end.
  float* place(float* memory, int image_width) {
    width = image_width;
    const int pitch = width + 2 * kSsimRadius;
    for (int m = 0; m < kMaps; ++m) {
      padded[m] = memory, memory += pitch;
      ring[m] = memory, memory += kSpan * width;
      blurred[m] = memory, memory += width;
      std::fill(padded[m], padded[m] + pitch, 0.0f);
    }
    return memory;
  }
  float* input(int m) { return padded[m] + kSsimRadius; }
  float* slot(int m, int row) { return ring[m] + (row + 2 * kSpan) % kSpan * width; }
  void push(int row) {
    for (int m = 0; m < kMaps; ++m) blur_row(padded[m], slot(m, row), width);
  }
  void push_zeros(int row) {
    for (int m = 0; m < kMaps; ++m) std::fill_n(slot(m, row), width, 0.0f);
  }
  void column(int row) {
    for (int m = 0; m < kMaps; ++m) {
      const float* rows[kSpan];
      for (int k = 0; k < kSpan; ++k) rows[k] = slot(m, row - kSsimRadius + k);
      blur_column(rows, blurred[m], width);
    }
  }
};

inline void products_row(const float* __restrict a, const float* __restrict b, float* __restrict aa, float* __restrict bb,
                         float* __restrict ab, int width) {
  for (int x = 0; x < width; ++x) aa[x] = a[x] * a[x], bb[x] = b[x] * b[x], ab[x] = a[x] * b[x];
}

// One row of the loss: `blurred` holds the blurred image, target, image^2, target^2 and image target; writes the derivatives of
// weight * SSIM to the blurred image, image^2 and image target from pixel `begin` on while W pixels are left, and adds the row's sums.
// Returns where it stopped.
template <int W, bool kWeighted>
inline int ssim_row(const float* a, const float* b, const float* weight, float* const* blurred, float* const* derivative, int begin,
                    int width, double sums[3]) {
  using V = Vec<float, W>;
  const V two = V::set(2), c1 = V::set(kC1), c2 = V::set(kC2), zero = V::set(0);
  V l1 = zero, square = zero, ssim = zero;
  int x = begin;
  for (; x + W <= width; x += W) {
    const V w = kWeighted ? V::load(weight + x) : V::set(1), u = V::load(blurred[0] + x), v = V::load(blurred[1] + x);
    const V uu = u * u, vv = v * v, uv = u * v;
    const V a1 = fma(two, uv, c1), a2 = fma(two, V::load(blurred[4] + x) - uv, c2);
    const V b1 = uu + vv + c1, b2 = (V::load(blurred[2] + x) - uu) + (V::load(blurred[3] + x) - vv) + c2;
    const V inverse = rcp(b1 * b2), scaled = w * inverse, s = a1 * a2 * scaled;
    const V d = V::load(a + x) - V::load(b + x);
    l1 = fma(w, max(d, zero - d), l1);
    square = fma(w * d, d, square);
    ssim = ssim + s;
    (two * (v * (a2 - a1) * scaled + u * s * (b1 - b2) * inverse)).store(derivative[0] + x);
    (zero - s * b1 * inverse).store(derivative[1] + x);
    (two * a1 * scaled).store(derivative[2] + x);
  }
  sums[0] += sum(l1), sums[1] += sum(square), sums[2] += sum(ssim);
  return x;
}

inline void gradient_row(const float* __restrict a, const float* __restrict b, const float* weight, const float* const* blurred,
                         float l1_scale, float ssim_scale, float* __restrict out, int width) {
  const float *d_mean = blurred[0], *d_square = blurred[1], *d_cross = blurred[2];
  for (int x = 0; x < width; ++x) {
    const float d = a[x] - b[x], sign = d > 0 ? 1.0f : d < 0 ? -1.0f : 0.0f;
    out[x] = l1_scale * sign + ssim_scale * (d_mean[x] + 2 * a[x] * d_square[x] + b[x] * d_cross[x]);
  }
  if (weight)  // the SSIM part carries its weight already
    for (int x = 0; x < width; ++x) {
      const float d = a[x] - b[x], sign = d > 0 ? 1.0f : d < 0 ? -1.0f : 0.0f;
      out[x] += l1_scale * sign * (weight[x] - 1);
    }
}

// Loss sums and gradient of rows [begin, end) of a channel in one sweep: blur, SSIM and its derivatives, and their blur again (the
// window is symmetric and zeros lie beyond the border, so the blur is its own adjoint). Rows around the strip are computed twice.
template <int W>
inline void photometric(const PhotometricParams& P, int channel, int begin, int end, float* buffer, double* sums) {
  const int width = P.width, height = P.height;
  const int64_t plane = int64_t(width) * height;
  const float *image = P.image + channel * plane, *target = P.target + channel * plane;
  const float l1_scale = float((1.0 - P.dssim) / P.weight_sum), ssim_scale = float(-P.dssim / P.weight_sum);
  RowBlur<5> moments;
  RowBlur<3> derivatives;
  derivatives.place(moments.place(buffer, width), width);
  float* derivative[3] = {derivatives.input(0), derivatives.input(1), derivatives.input(2)};
  for (int row = begin - 2 * kSsimRadius; row < end + 2 * kSsimRadius; ++row) {
    if (row >= 0 && row < height) {
      const float *a = image + int64_t(row) * width, *b = target + int64_t(row) * width;
      std::copy_n(a, width, moments.input(0));
      std::copy_n(b, width, moments.input(1));
      products_row(a, b, moments.input(2), moments.input(3), moments.input(4), width);
      moments.push(row);
    } else {
      moments.push_zeros(row);
    }
    const int middle = row - kSsimRadius;
    if (middle < begin - kSsimRadius) continue;
    if (middle >= 0 && middle < height) {
      moments.column(middle);
      const int64_t at = int64_t(middle) * width;
      const float *a = image + at, *b = target + at, *weight = P.weight ? P.weight + at : nullptr;
      double row_sums[3] = {0, 0, 0};
      const int rest = weight ? ssim_row<W, true>(a, b, weight, moments.blurred, derivative, 0, width, row_sums)
                              : ssim_row<W, false>(a, b, weight, moments.blurred, derivative, 0, width, row_sums);
      weight ? ssim_row<1, true>(a, b, weight, moments.blurred, derivative, rest, width, row_sums)
             : ssim_row<1, false>(a, b, weight, moments.blurred, derivative, rest, width, row_sums);
      if (middle >= begin && middle < end)
        for (int k = 0; k < 3; ++k) sums[k] += row_sums[k];
      derivatives.push(middle);
    } else {
      derivatives.push_zeros(middle);
    }
    const int out = middle - kSsimRadius;
    if (out < begin) continue;
    derivatives.column(out);
    const int64_t at = int64_t(out) * width;
    gradient_row(image + at, target + at, P.weight ? P.weight + at : nullptr, derivatives.blurred, l1_scale, ssim_scale,
                 P.gradient + channel * plane + at, width);
  }
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
