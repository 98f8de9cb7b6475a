#include "photo_sweep.h"

#include <algorithm>
#include <cmath>

#include "parallel.h"

namespace linprim {
namespace {

constexpr int64_t kPointsPerTask = 4096;
constexpr double kLeastFacing = 0.1;  // flatter points slope no more than this cosine says

float bilinear(const PhotoView& view, double u, double v) {
  const double x = std::clamp(u - 0.5, 0.0, double(view.width - 1)), y = std::clamp(v - 0.5, 0.0, double(view.height - 1));
  const int j = std::min(int(x), std::max(view.width - 2, 0)), i = std::min(int(y), std::max(view.height - 2, 0));
  const int right = std::min(j + 1, view.width - 1), below = std::min(i + 1, view.height - 1);
  const float a = float(x - j), b = float(y - i);
  const float* top = view.image + int64_t(i) * view.width;
  const float* bottom = view.image + int64_t(below) * view.width;
  const float above = top[j] + a * (top[right] - top[j]), under = bottom[j] + a * (bottom[right] - bottom[j]);
  return above + b * (under - above);
}

// Camera coordinates of a direction.
void turn(const double* pose, const double* x, double* out) {
  for (int r = 0; r < 3; ++r) out[r] = pose[4 * r] * x[0] + pose[4 * r + 1] * x[1] + pose[4 * r + 2] * x[2];
}

void add_point(const PhotoView& view, const PhotoRules& rules, const double* offset, int offsets, const PhotoSums& sums, int64_t p) {
  double at[3], normal[3];
  turn(view.pose, sums.point + 3 * p, at);
  for (int r = 0; r < 3; ++r) at[r] += view.pose[4 * r + 3];
  const double z = at[2];
  if (!(z > 0)) return;
  turn(view.pose, sums.normal + 3 * p, normal);
  const double length = std::sqrt(at[0] * at[0] + at[1] * at[1] + z * z);
  const double facing = -(at[0] * normal[0] + at[1] * normal[1] + z * normal[2]) / length;
  if (!(facing > rules.least_cosine)) return;
  const double u = at[0] / z * view.fx + view.cx, v = at[1] / z * view.fy + view.cy;
  if (!(u >= 0 && u < view.width && v >= 0 && v < view.height)) return;
  const int64_t pixel = int64_t(v) * view.width + int64_t(u);
  // From one pixel to the next the depth of a plane changes by a pixel's footprint times the tangent.
  const double cosine = std::max(facing, kLeastFacing), step = z / std::min(view.fx, view.fy);
  const double slope = step * (1 + std::sqrt(1 / (cosine * cosine) - 1));
  if (!(z <= view.depth[pixel] + slope && view.jump[pixel] <= rules.outline_slopes * slope)) return;

  const float weight = float(facing);
  float *value = sums.value + p * offsets, *square = sums.square + p * offsets;
  for (int k = 0; k < offsets; ++k)
    if (!(z + offset[k] * sums.footprint[p] * normal[2] > 0)) return;
  for (int k = 0; k < offsets; ++k) {
    const double along = offset[k] * sums.footprint[p], depth = z + along * normal[2];
    const float found = bilinear(view, (at[0] + along * normal[0]) / depth * view.fx + view.cx,
                                 (at[1] + along * normal[1]) / depth * view.fy + view.cy);
    value[k] += weight * found, square[k] += weight * found * found;
  }
  sums.weight[p] += weight;
  ++sums.views[p];
}

}  // namespace

void add_photo(const PhotoView& view, const PhotoRules& rules, const double* offset, int offsets, const PhotoSums& sums) {
  const int64_t tasks = (sums.count + kPointsPerTask - 1) / kPointsPerTask;
  parallel_for(tasks, [&](int64_t task, int) {
    const int64_t end = std::min((task + 1) * kPointsPerTask, sums.count);
    for (int64_t p = task * kPointsPerTask; p < end; ++p) add_point(view, rules, offset, offsets, sums, p);
  });
}

}  // namespace linprim
