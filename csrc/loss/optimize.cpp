// The parallel drivers of the image loss, pixel averaging, the optimiser step and the check for non-finite values.
#include <algorithm>
#include <array>
#include <cmath>
#include <mutex>
#include <vector>

#include "raster/instruction_set.h"
#include "linprim.h"
#include "base/parallel.h"

namespace linprim {

Photometric photometric_loss(const float* image, const float* target, const float* weight, int width, int height,
                             float dssim, float* gradient) {
  constexpr double kNoWeight = 1e-12;
  constexpr int kMinRows = 64;  // of a part, which also computes most intermediate values of the 20 rows around it
  static std::mutex mutex;
  static auto* buffers = new std::vector<float>;
  std::lock_guard lock(mutex);
  const int64_t plane = int64_t(width) * height, buffer_size = photometric_buffer_size(width);
  if (int64_t(buffers->size()) < threads() * buffer_size) buffers->resize(size_t(threads() * buffer_size));
  PhotometricParams params{image, target, weight, width, height, dssim, double(plane), gradient};
  if (weight) {
    params.weight_sum = 0;
    for (int64_t i = 0; i < plane; ++i) params.weight_sum += weight[i];
  }
  params.weight_sum = std::max(3 * params.weight_sum, kNoWeight);
  // Sums are kept per row and tile, so that the result does not depend on how rows are divided among threads.
  const int tiles = photometric_tiles(width), columns = 3 * tiles;
  int parts = threads() == 1 ? 1 : (2 * threads() + columns - 1) / columns;
  parts = std::clamp(parts, 1, std::max(1, height / kMinRows));
  const int part_rows = ((height + parts - 1) / parts + kSsimRows - 1) / kSsimRows * kSsimRows;
  parts = (height + part_rows - 1) / part_rows;
  std::vector<std::array<double, 3>> sums(size_t(columns) * height, std::array<double, 3>{0, 0, 0});
  parallel_for(int64_t(columns) * parts, [&](int64_t task, int thread) {
    const int column = int(task / parts), begin = int(task % parts) * part_rows;
    image_kernels().photometric(params, column / tiles, column % tiles, begin, std::min(height, begin + part_rows),
                                buffers->data() + thread * buffer_size, sums[size_t(column) * height].data());
  });
  Photometric result{0, 0, 0, 0};
  double lost = 0;
  for (const auto& [l1, square, off] : sums) result.l1 += l1, result.mse += square, lost += off;
  result.l1 /= params.weight_sum, result.mse /= params.weight_sum, result.ssim = 1.0 - lost / params.weight_sum;
  if (params.weight_sum <= kNoWeight) return {0, 0, 1, 0};  // no weights; the kernel wrote a gradient of 0
  result.loss = (1.0 - dssim) * result.l1 + dssim * (1.0 - result.ssim);
  return result;
}

void adam_step(float* value, const float* gradient, float* first, float* second, int64_t n, float rate, float beta1,
               float beta2, float epsilon, int64_t step) {
  constexpr int64_t kPerTask = 1 << 15;
  const AdamParams params{value,
                          first,
                          second,
                          gradient,
                          n,
                          rate,
                          beta1,
                          beta2,
                          epsilon,
                          float(1.0 - std::pow(double(beta1), double(step))),
                          float(1.0 - std::pow(double(beta2), double(step)))};
  parallel_for((n + kPerTask - 1) / kPerTask, [&](int64_t task, int) {
    image_kernels().adam(params, task * kPerTask, std::min(n, (task + 1) * kPerTask));
  });
}

namespace {

// Table of Adam's bias corrections, 1 / (1 - beta1^t) and 1 / sqrt(1 - beta2^t) for step t, until both are 1 in single
// precision.
struct Corrections {
  float beta1 = -1, beta2 = -1;
  std::vector<float> inverse, root;
  bool complete = false;

  // Fills the table, unless it is for these betas already.
  void make(float b1, float b2) {
    constexpr int kMost = 1 << 16;  // enough for beta2 = 0.9997; for larger ones the kernel computes the steps beyond
    if (b1 == beta1 && b2 == beta2) return;
    beta1 = b1, beta2 = b2, complete = false;
    inverse.assign(1, 1.0f), root.assign(1, 1.0f);  // step 0 is not used
    double power1 = 1, power2 = 1;
    for (int t = 1; t < kMost && !complete; ++t) {
      power1 *= double(b1), power2 *= double(b2);
      inverse.push_back(float(1 / (1 - power1))), root.push_back(float(1 / std::sqrt(1 - power2)));
      complete = inverse.back() == 1 && root.back() == 1;
    }
  }
};

}  // namespace

void adam_rows(const RowTensor* tensors, int count, int64_t n, const uint8_t* touched, int32_t* steps, float beta1,
               float beta2, float epsilon) {
  constexpr int64_t kPerTask = kAdamRows;
  static std::mutex mutex;
  static auto* corrections = new Corrections;
  std::lock_guard lock(mutex);
  corrections->make(beta1, beta2);
  const AdamRowsParams params{tensors,
                              count,
                              touched,
                              steps,
                              beta1,
                              beta2,
                              epsilon,
                              corrections->inverse.data(),
                              corrections->root.data(),
                              int64_t(corrections->inverse.size()),
                              corrections->complete};
  parallel_for((n + kPerTask - 1) / kPerTask, [&](int64_t task, int) {
    image_kernels().adam_rows(params, task * kPerTask, std::min(n, (task + 1) * kPerTask));
  });
}

namespace {

// Writes one row of means of factor x factor pixels. Factor 2, the usual one, has a loop that the compiler can
// vectorise.
template <class Real>
void average_row(const Real* fine, int width, int factor, Real* __restrict out) {
  const int64_t pitch = int64_t(width) * factor;
  if (factor == 2) {
    const Real *a = fine, *b = fine + pitch;
    for (int x = 0; x < width; ++x) out[x] = ((a[2 * x] + a[2 * x + 1]) + (b[2 * x] + b[2 * x + 1])) * Real(0.25);
    return;
  }
  for (int x = 0; x < width; ++x) {
    Real sum = 0;
    for (int j = 0; j < factor; ++j)
      for (int i = 0; i < factor; ++i) sum += fine[j * pitch + int64_t(x) * factor + i];
    out[x] = sum / Real(factor * factor);
  }
}

// Adjoint of average_row: writes `factor` rows of gradients.
template <class Real>
void spread_row(const Real* coarse, int width, int factor, Real* __restrict fine) {
  const int64_t pitch = int64_t(width) * factor;
  const Real part = Real(1) / Real(factor * factor);
  for (int x = 0; x < width; ++x)
    for (int i = 0; i < factor; ++i) fine[int64_t(x) * factor + i] = coarse[x] * part;
  for (int j = 1; j < factor; ++j) std::copy_n(fine, pitch, fine + j * pitch);
}

constexpr int kRowsPerTask = 16;

}  // namespace

template <class Real>
void average_pixels(const Real* fine, int planes, int width, int height, int factor, Real* coarse) {
  const int64_t rows = int64_t(planes) * height;
  parallel_for((rows + kRowsPerTask - 1) / kRowsPerTask, [&](int64_t task, int) {
    for (int64_t row = task * kRowsPerTask; row < std::min(rows, (task + 1) * kRowsPerTask); ++row)
      average_row(fine + row * width * factor * factor, width, factor, coarse + row * width);
  });
}

template <class Real>
void average_pixels_grad(const Real* coarse_grad, int planes, int width, int height, int factor, Real* fine_grad) {
  const int64_t rows = int64_t(planes) * height;
  parallel_for((rows + kRowsPerTask - 1) / kRowsPerTask, [&](int64_t task, int) {
    for (int64_t row = task * kRowsPerTask; row < std::min(rows, (task + 1) * kRowsPerTask); ++row)
      spread_row(coarse_grad + row * width, width, factor, fine_grad + row * width * factor * factor);
  });
}
template void average_pixels<float>(const float*, int, int, int, int, float*);
template void average_pixels<double>(const double*, int, int, int, int, double*);
template void average_pixels_grad<float>(const float*, int, int, int, int, float*);
template void average_pixels_grad<double>(const double*, int, int, int, int, double*);

template <class Real>
int64_t first_non_finite(const Real* values, int64_t n) {
  constexpr int64_t kRun = 4096;
  for (int64_t begin = 0; begin < n; begin += kRun) {
    const int64_t end = std::min(n, begin + kRun);
    Real sums[16] = {};  // 0 unless a term was NaN or infinite; sixteen, so that the compiler vectorises
    int64_t i = begin;
    for (; i + 16 <= end; i += 16)
      for (int l = 0; l < 16; ++l) sums[l] += values[i + l] * Real(0);
    for (; i < end; ++i) sums[0] += values[i] * Real(0);
    if (std::all_of(sums, sums + 16, [](Real s) { return s == 0; })) continue;
    for (i = begin; i < end; ++i)
      if (!std::isfinite(values[i])) return i;
  }
  return -1;
}
template int64_t first_non_finite<float>(const float*, int64_t);
template int64_t first_non_finite<double>(const double*, int64_t);

}  // namespace linprim
