#include "surface/photo_consistency.h"

#include "base/parallel.h"

namespace linprim {
namespace {

constexpr double kLeastFacing = 0.1;  // lower limit of the cosine of the viewing angle in slopes

// Adds the samples of one point, if the photograph sees it well.
void add_point(const PhotoView& view, const float* jump, const PhotoRules& rules, const double* offset, int offsets,
               const PhotoSums& sums, int64_t p) {
  SeenPoint seen;
  if (!look(view, rules.least_cosine, sums.point + 3 * p, sums.normal + 3 * p, seen)) return;
  const double *at = seen.at, *normal = seen.normal, z = at[2];
  const int64_t pixel = seen.pixel(view.width);
  const double step = z / std::min(view.fx, view.fy), slope = step + slope_across(step, seen.facing, kLeastFacing);
  if (!(z <= view.depth[pixel] + slope && jump[pixel] <= rules.outline_slopes * slope)) return;

  const float weight = float(seen.facing);
  float *value = sums.value + p * offsets, *square = sums.square + p * offsets;
  for (int k = 0; k < offsets; ++k)
    if (!(z + offset[k] * sums.footprint[p] * normal[2] > 0)) return;
  for (int k = 0; k < offsets; ++k) {
    const double along = offset[k] * sums.footprint[p], depth = z + along * normal[2];
    float found;
    bilinear(view, (at[0] + along * normal[0]) / depth * view.fx + view.cx,
             (at[1] + along * normal[1]) / depth * view.fy + view.cy, &found);
    value[k] += weight * found, square[k] += weight * found * found;
  }
  sums.weight[p] += weight;
  ++sums.views[p];
}

}  // namespace

void add_photo(const PhotoView& view, const float* jump, const PhotoRules& rules, const double* offset, int offsets,
               const PhotoSums& sums) {
  for_rows(sums.count, [&](int64_t p) { add_point(view, jump, rules, offset, offsets, sums, p); });
}

void least_footprints(const PhotoView& view, double least_cosine, const double* point, const double* normal,
                      int64_t count, double* least) {
  const double focal = std::sqrt(view.fx * view.fy);
  for_rows(count, [&](int64_t p) {
    SeenPoint seen;
    if (look(view, least_cosine, point + 3 * p, normal + 3 * p, seen))
      least[p] = std::min(least[p], seen.at[2] / (focal * seen.facing));
  });
}

}  // namespace linprim
