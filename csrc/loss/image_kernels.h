// L1 + D-SSIM with its gradient, and Adam.
//
// SSIM as in 3DGS: 11x11 Gaussian window with sigma 1.5, zeros beyond the border, C1 = 0.01^2, C2 = 0.03^2, mean over
// pixels. Included by kernels.cpp only.
#pragma once

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>
#include <utility>

#include "raster/kernel_table.h"
#include "base/simd.h"

namespace linprim::LINPRIM_ISA {

constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
// exp(-i^2 / (2 sigma^2)) / sum for i = 0..5, sigma 1.5: half of the symmetric window.
constexpr float kWindow[kSsimRadius + 1] = {0.26601171493530273f, 0.21300552785396576f, 0.10936068743467331f,
                                            0.03600077331066132f, 0.00759875820949674f, 0.0010283800877257609f};
constexpr int kTaps = 2 * kSsimRadius + 1;

// Rows of kMaps maps in groups of kSsimRows. Three consecutive groups are kept, enough to blur the middle one along y.
template <int kMaps>
struct RowGroups {
  float* memory;
  int64_t pitch;
  float* row(int map, int row) const {
    return memory + (int64_t(map) * 3 * kSsimRows + (row + 3 * kSsimRows) % (3 * kSsimRows)) * pitch;
  }
  static int64_t size(int64_t pitch) { return kMaps * 3 * kSsimRows * pitch; }
};

// Blurs columns [begin, end) of kSsimRows consecutive rows of one map along y; `rows` are those from kSsimRadius above
// the first to kSsimRadius below the last. Each row is loaded once for all output rows that it contributes to.
template <int W>
inline void blur_rows(const float* const* rows, float* __restrict out, int64_t pitch, int begin, int end) {
  using V = Vec<float, W>;
  for (int x = begin; x < end; x += W) {
    V sum[kSsimRows];
#pragma GCC unroll 32
    for (int j = 0; j < kSsimRows + 2 * kSsimRadius; ++j) {
      const V value = V::load(rows[j] + x);
#pragma GCC unroll 32
      for (int r = 0; r < kSsimRows; ++r) {
        const int tap = j - r - kSsimRadius;
        if (tap < -kSsimRadius || tap > kSsimRadius) continue;
        const V weight = V::set(kWindow[tap < 0 ? -tap : tap]);
        sum[r] = tap == -kSsimRadius ? weight * value : fma(weight, value, sum[r]);
      }
    }
#pragma GCC unroll 32
    for (int r = 0; r < kSsimRows; ++r) sum[r].store(out + r * pitch + x);
  }
}

// Blurs W pixels along x, the first at `center`; with two sums, because one would be a long dependency chain.
template <int W>
inline Vec<float, W> blur_along(const float* center) {
  using V = Vec<float, W>;
  V even = V::set(kWindow[0]) * V::load(center), odd = V::set(kWindow[1]) * V::load(center - 1);
  odd = fma(V::set(kWindow[1]), V::load(center + 1), odd);
#pragma GCC unroll 32
  for (int tap = 2; tap <= kSsimRadius; ++tap) {
    V& sum = tap % 2 ? odd : even;
    const V weight = V::set(kWindow[tap]);
    sum = fma(weight, V::load(center + tap), fma(weight, V::load(center - tap), sum));
  }
  return even + odd;
}

// The four maps whose means SSIM needs, of image a and target b. With d = a - b instead of b and a b, values that are
// small where the images agree are not differences of large numbers.
struct Moment {
  static constexpr int kImage = 0, kDifference = 1, kSquares = 2 /* a^2 + b^2 */, kDifferenceSquare = 3, kCount = 4;
};
// The gradient of the SSIM part to the image is D0 + a D1 + d D2, each blurred from the output of ssim_row.
constexpr int kDerivatives = 3;

// Writes a row of the four maps, starting at pixel `left` of the image, in columns [0, pitch); 0 outside the image.
template <int W>
inline void moment_row(const float* image, const float* target, int width, int left, int64_t pitch,
                       const RowGroups<Moment::kCount>& out, int row) {
  float *a = out.row(Moment::kImage, row), *d = out.row(Moment::kDifference, row);
  float *squares = out.row(Moment::kSquares, row), *square = out.row(Moment::kDifferenceSquare, row);
  const int begin = std::max(0, -left), end = int(std::min<int64_t>(pitch, width - left));
  for (float* map : {a, d, squares, square}) std::fill(map, map + begin, 0.0f), std::fill(map + end, map + pitch, 0.0f);
  auto columns = [&](auto one, int x, int last) {
    using V = decltype(one);
    constexpr int kStep = sizeof(V) / sizeof(float);
    for (; x + kStep <= last; x += kStep) {
      const V p = V::load(image + left + x), q = V::load(target + left + x), e = p - q;
      p.store(a + x), e.store(d + x), fma(p, p, q * q).store(squares + x), (e * e).store(square + x);
    }
    return x;
  };
  columns(Vec<float, 1>{}, columns(Vec<float, W>{}, begin, end), end);
}

// For columns [begin, end) of a row: takes the row's maps blurred along y, blurs them along x, and writes the
// derivatives of weight (1 - SSIM), which are then blurred in turn; adds the columns' sums of weight times |a - b|, (a
// - b)^2 and 1 - SSIM.
//
// With the means A, B, their difference D = A - B, M = A^2 + B^2 and V the sum of both variances: 1 - SSIM = 1 - a1 a2
// / (b1 b2), b1 = M + C1, a1 = b1 - D^2, b2 = V + C2, a2 = b2 - (variance of a - b).
template <int W>
inline void ssim_row(const float* const* blurred, const float* difference, const float* weight,
                     float* const* derivative, int begin, int end, double sums[3]) {
  using V = Vec<float, W>;
  const V two = V::set(2), c1 = V::set(kC1), c2 = V::set(kC2), zero = V::set(0);
  V l1 = zero, square = zero, off = zero;
  for (int x = begin; x < end; x += W) {
    const V a = blur_along<W>(blurred[Moment::kImage] + x), d = blur_along<W>(blurred[Moment::kDifference] + x);
    const V squares = blur_along<W>(blurred[Moment::kSquares] + x),
            difference_square = blur_along<W>(blurred[Moment::kDifferenceSquare] + x);
    const V w = V::load(weight + x), b = a - d, dd = d * d, m = fma(a, a, b * b);
    const V b1 = m + c1, b2 = (squares - m) + c2, variance = difference_square - dd;
    const V a1 = b1 - dd, a2 = b2 - variance;
    const V inverse = rcp(b1 * b2), scaled = w * inverse;
    const V lost = fma(b1, variance, a2 * dd) * inverse;  // 1 - SSIM
    const V twice = two * scaled;
    // d SSIM / dA = 2 (B (a2 - a1) + A SSIM (b1 - b2)) / (b1 b2); similarly the other two, to a^2 + b^2 and (a - b)^2.
    (twice * fma(b2 - b1, d - a * lost, b * (variance - dd))).store(derivative[0] + x);
    (zero - twice * a1 * variance * b1 * inverse).store(derivative[1] + x);
    (twice * a1).store(derivative[2] + x);
    const V e = V::load(difference + x);
    l1 = fma(w, max(e, zero - e), l1);
    square = fma(w * e, e, square);
    off = fma(w, lost, off);
  }
  sums[0] += sum(l1), sums[1] += sum(square), sums[2] += sum(off);
}

// Writes columns [begin, end) of the gradient, from the derivatives blurred along y.
template <int W>
inline void gradient_row(const float* const* blurred, const float* image, const float* difference, const float* weight,
                         float l1_scale, float ssim_scale, float* out, int begin, int end) {
  using V = Vec<float, W>;
  const V zero = V::set(0), one = V::set(l1_scale), scale = V::set(ssim_scale);
  for (int x = begin; x < end; x += W) {
    const V e = V::load(difference + x), a = V::load(image + x);
    const V mean = blur_along<W>(blurred[0] + x), square = blur_along<W>(blurred[1] + x),
            cross = blur_along<W>(blurred[2] + x);
    const V sign = select(zero < e, one, select(e < zero, zero - one, zero));
    fma(scale, fma(e, cross, fma(a, square, mean)), sign * V::load(weight + x)).store(out + (x - begin));
  }
}

// Loss sums and gradient of rows [begin, end) and one tile of columns of a channel in one pass: blur, SSIM and its
// derivatives, and the blur of these (the window is symmetric and zeros lie beyond the border, so the blur is its own
// adjoint). Rows and columns around the part are computed too; the results of a row do not depend on where the part
// begins.
template <int W>
inline void photometric(const PhotometricParams& P, int channel, int tile, int begin, int end, float* buffer,
                        double* row_sums) {
  constexpr int kPad = 2 * kSsimAlign;
  const int width = P.width, height = P.height, columns = photometric_columns(width);
  const int left = tile * columns, right = std::min(width, left + columns);
  const int64_t pitch = photometric_pitch(width), plane = int64_t(width) * height;
  const float *image = P.image + channel * plane, *target = P.target + channel * plane;
  const float l1_scale = float((1.0 - P.dssim) / P.weight_sum), ssim_scale = float(P.dssim / P.weight_sum);
  // Local columns, which start kPad before `left`: of the part, of its derivatives, which are 0 beyond the image, and
  // of the inputs that these need.
  const int first = kPad, last = kPad + (right - left + kSsimAlign - 1) / kSsimAlign * kSsimAlign;
  const int outer_first = left > 0 ? first - kSsimAlign : first, outer_last = right < width ? last + kSsimAlign : last;
  buffer += (kSsimAlign - reinterpret_cast<uintptr_t>(buffer) / sizeof(float) % kSsimAlign) % kSsimAlign;
  const RowGroups<Moment::kCount> moments{buffer, pitch};
  const RowGroups<kDerivatives> derivatives{moments.memory + moments.size(pitch), pitch};
  float* blurred = derivatives.memory + derivatives.size(pitch);  // kSsimRows rows of each map
  float *weights = blurred + Moment::kCount * kSsimRows * pitch, *zeros = weights + pitch;
  std::fill(derivatives.memory, blurred, 0.0f);
  std::fill(zeros, zeros + pitch, 0.0f);
  const int inside_first = std::max(0, kPad - left), inside_last = int(std::min<int64_t>(pitch, width - left + kPad));
  std::fill(weights, weights + pitch, 0.0f);
  std::fill(weights + inside_first, weights + inside_last, 1.0f);
  auto load_weights = [&](int row) {
    if (P.weight)
      std::copy_n(P.weight + int64_t(row) * width + left - kPad + inside_first, inside_last - inside_first,
                  weights + inside_first);
  };
  // Blurs columns [from, to) of all rows of a group along y.
  auto blur_group = [&](const auto& groups, int maps, int group, int from, int to) {
    for (int m = 0; m < maps; ++m) {
      const float* rows[kSsimRows + 2 * kSsimRadius];
      for (int j = 0; j < kSsimRows + 2 * kSsimRadius; ++j) {
        const int row = group * kSsimRows - kSsimRadius + j;
        rows[j] = row >= 0 && row < height ? groups.row(m, row) : zeros;
      }
      blur_rows<W>(rows, blurred + m * kSsimRows * pitch, pitch, from, to);
    }
  };
  const int group_first = begin / kSsimRows, group_last = (end + kSsimRows - 1) / kSsimRows;
  for (int group = group_first - 2; group < group_last + 2; ++group) {
    auto rows_of = [&](int of, int around) {
      return std::pair(std::max({0, begin - around, of * kSsimRows}),
                       std::min({height, end + around, (of + 1) * kSsimRows}));
    };
    const auto [load_first, load_last] = rows_of(group, 2 * kSsimRadius);
    for (int row = load_first; row < load_last; ++row)
      moment_row<W>(image + int64_t(row) * width, target + int64_t(row) * width, width, left - kPad, pitch, moments,
                    row);

    const auto [middle_first, middle_last] = rows_of(group - 1, kSsimRadius);
    if (middle_first < middle_last)
      blur_group(moments, Moment::kCount, group - 1, outer_first - kSsimAlign, outer_last + kSsimAlign);
    for (int row = middle_first; row < middle_last; ++row) {
      const float *in[Moment::kCount], *difference = moments.row(Moment::kDifference, row);
      float* out[kDerivatives];
      for (int m = 0; m < Moment::kCount; ++m) in[m] = blurred + (m * kSsimRows + row % kSsimRows) * pitch;
      for (int m = 0; m < kDerivatives; ++m) out[m] = derivatives.row(m, row);
      load_weights(row);
      double around[3] = {0, 0, 0}, *sums = row >= begin && row < end ? row_sums + 3 * row : around;
      ssim_row<W>(in, difference, weights, out, outer_first, first, around);
      ssim_row<W>(in, difference, weights, out, first, last, sums);
      ssim_row<W>(in, difference, weights, out, last, outer_last, around);
    }

    const auto [out_first, out_last] = rows_of(group - 2, 0);
    if (out_first < out_last) blur_group(derivatives, kDerivatives, group - 2, first - kSsimAlign, last + kSsimAlign);
    for (int row = out_first; row < out_last; ++row) {
      const float *in[kDerivatives], *a = moments.row(Moment::kImage, row), *d = moments.row(Moment::kDifference, row);
      for (int m = 0; m < kDerivatives; ++m) in[m] = blurred + (m * kSsimRows + row % kSsimRows) * pitch;
      load_weights(row);
      float* out = P.gradient + channel * plane + int64_t(row) * width + left;
      const int whole = (right - left) / W * W, rest = (right - left) - whole;
      gradient_row<W>(in, a, d, weights, l1_scale, ssim_scale, out, first, first + whole);
      if (rest > 0) {
        float tail[W];
        gradient_row<W>(in, a, d, weights, l1_scale, ssim_scale, tail, first + whole, first + whole + W);
        std::copy_n(tail, rest, out + whole);
      }
    }
  }
}

// Adam with bias correction (Kingma and Ba 2015, algorithm 1) on elements [begin, end).
inline void adam(const AdamParams& P, int64_t begin, int64_t end) {
  float* __restrict value = P.value, * __restrict first = P.first, * __restrict second = P.second;
  const float* __restrict gradient = P.gradient;
  const float step = P.rate / P.correction1, root = 1.0f / std::sqrt(P.correction2);
  for (int64_t i = begin; i < end; ++i) {
    const float g = gradient[i];
    first[i] = P.beta1 * first[i] + (1 - P.beta1) * g;
    second[i] = P.beta2 * second[i] + (1 - P.beta2) * g * g;
    value[i] -= step * first[i] / (std::sqrt(second[i]) * root + P.epsilon);
  }
}

// Updates N of a row's elements in W lanes. No byte beyond them is accessed, not even under a mask: a load of the next
// row would then have to wait for this row's store.
template <int W, int N = W>
inline void adam_part(const AdamRowsParams& P, const RowTensor& t, int64_t at, float step, float root) {
  using V = Vec<float, W>;
  static_assert(N == W || (W == 4 && N < 4));
  auto load = [&](const float* from) {
    from += at;
    if constexpr (N == W)
      return V::load(from);
    else
      return V{typename V::native{from[0], N > 1 ? from[1] : 0.0f, N > 2 ? from[2] : 0.0f, 0.0f}};
  };
  auto store = [&](V v, float* to) {
    to += at;
    if constexpr (N == W)
      v.store(to);
    else
      to[0] = v.v[0], to[N > 1 ? 1 : 0] = v.v[N > 1 ? 1 : 0], to[N - 1] = v.v[N - 1];
  };
  const V g = load(t.gradient), first = fma(V::set(P.beta1), load(t.first), V::set(1 - P.beta1) * g);
  const V second = fma(V::set(P.beta2), load(t.second), V::set(1 - P.beta2) * g * g);
#if defined(LINPRIM_ISA_V2) || defined(LINPRIM_ISA_V3) || defined(LINPRIM_ISA_V4)
  V deviation;
  if constexpr (W == 4)
    deviation = {(F4::native)_mm_sqrt_ps((__m128)second.v)};
  else
    deviation = sqrt(second);
#else
  const V deviation = sqrt(second);
#endif
  const V divisor = fma(deviation, V::set(root), V::set(P.epsilon));
  store(first, t.first), store(second, t.second);
  // One rounding, where a product with rcp has two.
  store(load(t.value) - V{(V::set(step) * first).v / divisor.v}, t.value);
}

// Returns whether any value is not 0; NaN counts as not 0.
inline bool any_nonzero(const float* values, int64_t n) {
  uint32_t bits = 0;
  for (int64_t k = 0; k < n; ++k) bits |= std::bit_cast<uint32_t>(values[k]) << 1;  // without the sign
  return bits != 0;
}

// Adam on the touched rows among [begin, end), each with its own step count; at most kAdamRows rows. Processed tensor
// by tensor, because the processor can prefetch only a few memory streams.
template <int W>
inline void adam_rows(const AdamRowsParams& P, int64_t begin, int64_t end) {
  constexpr int kLine = 16, kAhead = 6;
  int64_t rows[kAdamRows + kAhead];
  float inverse[kAdamRows], root[kAdamRows];  // 1 / (1 - beta1^steps), 1 / sqrt(1 - beta2^steps)
  int count = 0;
  for (int64_t row = begin; row < end; ++row) {
    bool touched = P.touched && P.touched[row];
    for (int i = 0; !P.touched && !touched && i < P.count; ++i)
      touched = any_nonzero(P.tensors[i].gradient + row * P.tensors[i].columns, P.tensors[i].columns);
    rows[count] = row, count += touched;
  }
  if (count == 0) return;
  for (int k = 0; k < count; ++k) {
    const int32_t steps = P.steps[rows[k]] += P.steps[rows[k]] < INT32_MAX;
    inverse[k] = root[k] = 1;
    if (steps < P.table_size) {
      inverse[k] = P.inverse[steps], root[k] = P.root[steps];
    } else if (!P.table_complete) {
      inverse[k] = float(1 / (1 - std::pow(double(P.beta1), steps)));
      root[k] = float(1 / std::sqrt(1 - std::pow(double(P.beta2), steps)));
    }
  }
  for (int k = count; k < count + kAhead; ++k) rows[k] = rows[count - 1];
  for (int i = 0; i < P.count; ++i) {
    const RowTensor t = P.tensors[i];
    for (int k = 0; k < count; ++k) {
      const int64_t last = (rows[k] + 1) * t.columns, next = rows[k + kAhead] * t.columns;
      for (int64_t c = 0; c < t.columns; c += kLine)
        __builtin_prefetch(t.gradient + next + c), __builtin_prefetch(t.value + next + c, 1),
            __builtin_prefetch(t.first + next + c, 1), __builtin_prefetch(t.second + next + c, 1);
      const float step = t.rate * inverse[k];
      int64_t at = rows[k] * t.columns;
      for (; at + W <= last; at += W) adam_part<W>(P, t, at, step, root[k]);
      if constexpr (W >= 4) {
        for (; at + 4 <= last; at += 4) adam_part<4>(P, t, at, step, root[k]);
        if (last - at == 3)
          adam_part<4, 3>(P, t, at, step, root[k]);
        else if (last - at == 2)
          adam_part<4, 2>(P, t, at, step, root[k]);
        else if (last - at == 1)
          adam_part<1>(P, t, at, step, root[k]);
      }
    }
  }
}

}  // namespace linprim::LINPRIM_ISA
