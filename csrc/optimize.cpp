// The parallel drivers of the image loss, the optimiser step and the check for non-finite values.
#include <algorithm>
#include <cmath>
#include <mutex>
#include <vector>

#include "instruction_set.h"
#include "linprim.h"
#include "parallel.h"

namespace linprim {

Photometric photometric_loss(const float* image, const float* target, const float* weight, int width, int height, float dssim,
                             float* gradient) {
  constexpr int kStripRows = 32;
  static std::mutex mutex;
  static auto* scratch = new std::vector<float>;
  std::lock_guard lock(mutex);
  const int64_t plane = int64_t(width) * height, buffer_size = photometric_buffer_size(width);
  const int64_t needed = 9 * plane + threads() * buffer_size;
  if (int64_t(scratch->size()) < needed) scratch->resize(size_t(needed));
  PhotometricParams params{image, target, weight, width, height, dssim, 0, gradient, scratch->data()};
  double weight_sum = double(plane);
  if (weight) {
    weight_sum = 0;
    for (int64_t i = 0; i < plane; ++i) weight_sum += weight[i];
  }
  params.weight_sum = std::max(3 * weight_sum, 1e-12);
  std::vector<double> l1(size_t(height) * 3), ssim(size_t(height) * 3);
  const int strips = (height + kStripRows - 1) / kStripRows;
  auto rows = [&](int64_t task, int thread, auto&& call) {
    const int channel = int(task / strips), begin = int(task % strips) * kStripRows;
    call(channel, begin, std::min(height, begin + kStripRows), scratch->data() + 9 * plane + thread * buffer_size);
  };
  parallel_for(3 * strips, [&](int64_t task, int thread) {
    rows(task, thread, [&](int channel, int begin, int end, float* buffer) {
      image_kernels().photometric_maps(params, channel, begin, end, buffer, &l1[size_t(channel) * height], &ssim[size_t(channel) * height]);
    });
  });
  parallel_for(3 * strips, [&](int64_t task, int thread) {
    rows(task, thread, [&](int channel, int begin, int end, float* buffer) {
      image_kernels().photometric_gradient(params, channel, begin, end, buffer);
    });
  });
  Photometric result{0, 0, 0};
  for (double x : l1) result.l1 += x;
  for (double x : ssim) result.ssim += x;
  result.l1 /= params.weight_sum, result.ssim /= params.weight_sum;
  result.loss = (1.0 - dssim) * result.l1 + dssim * (1.0 - result.ssim);
  return result;
}

void adam_step(float* value, const float* gradient, float* first, float* second, int64_t n, float rate, float beta1, float beta2,
               float epsilon, int64_t step) {
  constexpr int64_t kPerTask = 1 << 15;
  const AdamParams params{value, first, second, gradient, n, rate, beta1, beta2, epsilon,
                          float(1.0 - std::pow(double(beta1), double(step))), float(1.0 - std::pow(double(beta2), double(step)))};
  parallel_for((n + kPerTask - 1) / kPerTask,
               [&](int64_t task, int) { image_kernels().adam(params, task * kPerTask, std::min(n, (task + 1) * kPerTask)); });
}

template <class Real>
int64_t first_non_finite(const Real* values, int64_t n) {
  constexpr int64_t kRun = 4096;
  for (int64_t begin = 0; begin < n; begin += kRun) {
    const int64_t end = std::min(n, begin + kRun);
    Real sums[16] = {};  // each 0 unless it met a NaN or an infinity; sixteen, so that the compiler vectorises
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
