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

// A point and its normal in camera coordinates, the cosine between the normal and the direction to the camera, and its pixel.
struct Looked {
  double at[3], normal[3], facing, u, v;
};

// False where the point is behind the camera, flatter than `least_cosine`, or outside of the image.
bool look(const PhotoView& view, double least_cosine, const double* point, const double* normal, Looked& out) {
  turn(view.pose, point, out.at);
  for (int r = 0; r < 3; ++r) out.at[r] += view.pose[4 * r + 3];
  const double *at = out.at, z = at[2];
  if (!(z > 0)) return false;
  turn(view.pose, normal, out.normal);
  const double length = std::sqrt(at[0] * at[0] + at[1] * at[1] + z * z);
  out.facing = -(at[0] * out.normal[0] + at[1] * out.normal[1] + z * out.normal[2]) / length;
  if (!(out.facing > least_cosine)) return false;
  out.u = at[0] / z * view.fx + view.cx, out.v = at[1] / z * view.fy + view.cy;
  return out.u >= 0 && out.u < view.width && out.v >= 0 && out.v < view.height;
}

void add_point(const PhotoView& view, const PhotoRules& rules, const double* offset, int offsets, const PhotoSums& sums, int64_t p) {
  Looked seen;
  if (!look(view, rules.least_cosine, sums.point + 3 * p, sums.normal + 3 * p, seen)) return;
  const double *at = seen.at, *normal = seen.normal, z = at[2], facing = seen.facing;
  const int64_t pixel = int64_t(seen.v) * view.width + int64_t(seen.u);
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

// Calls body(p) for every point, some thousands per task.
template <class Body>
void for_points(int64_t count, const Body& body) {
  parallel_for((count + kPointsPerTask - 1) / kPointsPerTask, [&](int64_t task, int) {
    const int64_t end = std::min((task + 1) * kPointsPerTask, count);
    for (int64_t p = task * kPointsPerTask; p < end; ++p) body(p);
  });
}

}  // namespace

void add_photo(const PhotoView& view, const PhotoRules& rules, const double* offset, int offsets, const PhotoSums& sums) {
  for_points(sums.count, [&](int64_t p) { add_point(view, rules, offset, offsets, sums, p); });
}

void least_footprints(const PhotoView& view, double least_cosine, const double* point, const double* normal, int64_t count, double* least) {
  const double focal = std::sqrt(view.fx * view.fy);
  for_points(count, [&](int64_t p) {
    Looked seen;
    if (look(view, least_cosine, point + 3 * p, normal + 3 * p, seen)) least[p] = std::min(least[p], seen.at[2] / (focal * seen.facing));
  });
}

}  // namespace linprim
