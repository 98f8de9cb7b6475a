#include "surface/surfels.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "base/parallel.h"

namespace linprim {
namespace {

constexpr float kFarInFront = 1e9f;  // signed distance in truncations, in front of any surface
constexpr double kUnknown = std::numeric_limits<double>::quiet_NaN();  // inverse depth without a surface

// Returns the slope of the inverse depth from the neighbours that belong to the same surface: the mean of both slopes
// if these are similar, else the flatter one. A neighbour that is NaN is missing; without neighbours the slope is 0.
double slope_of(double before, double here, double after, double tolerance, double ratio) {
  const double ahead = after - here, back = here - before;
  if (std::isnan(ahead) && std::isnan(back)) return 0;
  if (std::isnan(back)) return ahead;
  if (std::isnan(ahead)) return back;
  const double least = std::min(std::abs(ahead), std::abs(back)), most = std::max(std::abs(ahead), std::abs(back));
  if (most <= ratio * least + tolerance) return 0.5 * (ahead + back);
  return std::abs(ahead) <= std::abs(back) ? ahead : back;
}

// Computes the surfel of a pixel from the inverse depths of it and its neighbours.
Surfel surfel_at(const DepthMap& map, const SurfelRules& rules, const std::vector<double>& inverse, int x, int y) {
  const auto at = [&](int column, int row) {
    const bool inside = column >= 0 && row >= 0 && column < map.width && row < map.height;
    return inside ? inverse[int64_t(row) * map.width + column] : kUnknown;
  };
  const int64_t pixel = int64_t(y) * map.width + x;
  const double here = inverse[pixel], confidence = map.confidence[pixel];
  Surfel surfel{};
  // Beside the outline of something nearer, a pixel does not tell whether space at that depth is free: its votes for
  // free space count only in front of all its neighbours.
  for (int row = y - 1; row <= y + 1; ++row)
    for (int column = x - 1; column <= x + 1; ++column)
      if (at(column, row) > surfel.nearest) surfel.nearest = float(at(column, row));
  if (std::isnan(here)) {
    surfel.offset = kFarInFront, surfel.cosine = 1, surfel.free = map.background[pixel] ? float(confidence) : 0;
    return surfel;
  }
  const double rx = (x + 0.5 - map.cx) / map.fx, ry = (y + 0.5 - map.cy) / map.fy, square = rx * rx + ry * ry + 1;
  // A difference of half a voxel of depth between neighbours is no sign of an edge.
  const double tolerance = 0.5 * rules.voxel * here * here;
  double a = map.fx * slope_of(at(x - 1, y), here, at(x + 1, y), tolerance, rules.slope_ratio);
  double b = map.fy * slope_of(at(x, y - 1), here, at(x, y + 1), tolerance, rules.slope_ratio);
  double c = here - a * rx - b * ry;
  double cosine = here / std::sqrt((a * a + b * b + c * c) * square);
  if (!(cosine > rules.least_cosine)) {
    a = here * rx / square, b = here * ry / square, c = here / square;
    cosine = rules.least_cosine;
  }
  const double scale = 1 / (std::sqrt(a * a + b * b + c * c) * rules.truncation),
               plane[3] = {a * scale, b * scale, c * scale};
  double offset = scale;
  for (int row = 0; row < 3; ++row) offset -= plane[row] * map.pose[4 * row + 3];
  for (int axis = 0; axis < 3; ++axis)
    surfel.plane[axis] =
        float(plane[0] * map.pose[axis] + plane[1] * map.pose[4 + axis] + plane[2] * map.pose[8 + axis]);
  surfel.offset = float(offset);
  surfel.weight = map.clamped[pixel] ? 0 : float(std::sqrt(cosine) * confidence);
  surfel.cosine = float(cosine), surfel.free = float(confidence);
  return surfel;
}

}  // namespace

void make_surfels(const DepthMap& map, const SurfelRules& rules, Surfel* surfels) {
  std::vector<double> inverse(int64_t(map.width) * map.height);
  for (size_t pixel = 0; pixel < inverse.size(); ++pixel) {
    const double depth = map.depth[pixel];
    inverse[pixel] = std::isfinite(depth) && depth > 0 ? 1 / depth : kUnknown;
  }
  parallel_for(map.height, [&](int64_t y, int) {
    for (int x = 0; x < map.width; ++x) surfels[y * map.width + x] = surfel_at(map, rules, inverse, x, int(y));
  });
}

}  // namespace linprim
