#include "surface/fuse.h"

#include <algorithm>

#include "base/parallel.h"

namespace linprim {
namespace {

constexpr int64_t kBlocksPerTask = 16;

// A vote for one voxel: signed distance in truncations, its weight, and the weight of free space.
struct Vote {
  float value, weight, free;
};

// Computes the vote of a surfel for a voxel: `value` is the voxel's signed distance in truncations, `inverse_depth` its
// 1/z.
Vote vote(const Surfel& surfel, const VoteRules& rules, float value, float inverse_depth) {
  if (value > 1) return {1, 0, inverse_depth > surfel.nearest ? surfel.free : 0};
  const float along = value / surfel.cosine;  // distance along the ray
  const bool near_plane = value > -rules.grazed && along > -rules.grazed_reach;
  if (along < -1) {
    const float grazed = near_plane ? surfel.weight * rules.grazed_weight : 0, hidden = surfel.free * rules.occluded;
    if (rules.occluded > 0 && !near_plane) value = -1;
    return {std::max(value, -1.0f), std::max(grazed, hidden), 0};
  }
  const float ahead = value / rules.near;
  const float share = value > 0 ? std::max(1 / (1 + ahead * ahead), rules.far_front)
                                : std::clamp(2 + along / rules.behind, rules.behind_weight, 1.0f);
  return {std::max(value, -1.0f), surfel.weight * share, 0};
}

// Adds the votes of a view to the block `row`.
void add_block(const SurfelView& view, const VoteRules& rules, const VoxelSums& sums, int64_t row) {
  const double* corner = sums.corner + 3 * row;
  const float voxel = float(sums.voxel), origin[3] = {float(corner[0]), float(corner[1]), float(corner[2])};
  float image[3], step[3][3];  // homogeneous pixel of the corner, and its change per voxel along x, y, z
  for (int r = 0; r < 3; ++r) {
    const double* p = view.project + 4 * r;
    image[r] = float(p[0] * corner[0] + p[1] * corner[1] + p[2] * corner[2] + p[3]);
    for (int axis = 0; axis < 3; ++axis) step[axis][r] = float(p[axis] * sums.voxel);
  }
  const int n = sums.resolution;
  const int64_t size = int64_t(n) * n * n;
  float *total = sums.total + row * size, *weight = sums.weight + row * size, *free = sums.free + row * size;
  for (int k = 0; k < n; ++k)
    for (int j = 0; j < n; ++j)
      for (int i = 0; i < n; ++i, ++total, ++weight, ++free) {
        const float z = image[2] + i * step[0][2] + j * step[1][2] + k * step[2][2];
        if (!(z > 0)) continue;
        const float inverse = 1 / z;
        const float u = (image[0] + i * step[0][0] + j * step[1][0] + k * step[2][0]) * inverse;
        const float v = (image[1] + i * step[0][1] + j * step[1][1] + k * step[2][1]) * inverse;
        if (!(u >= 0 && v >= 0 && u < view.width && v < view.height)) continue;
        const Surfel& surfel = view.surfels[int64_t(v) * view.width + int64_t(u)];
        const float value = surfel.offset - surfel.plane[0] * (origin[0] + i * voxel) -
                            surfel.plane[1] * (origin[1] + j * voxel) - surfel.plane[2] * (origin[2] + k * voxel);
        const Vote said = vote(surfel, rules, value, inverse);
        *total += said.weight * said.value, *weight += said.weight, *free += said.free;
      }
}

}  // namespace

void add_votes(const SurfelView& view, const VoteRules& rules, const int64_t* rows, int64_t count,
               const VoxelSums& sums) {
  parallel_for((count + kBlocksPerTask - 1) / kBlocksPerTask, [&](int64_t task, int) {
    const int64_t end = std::min((task + 1) * kBlocksPerTask, count);
    for (int64_t b = task * kBlocksPerTask; b < end; ++b) add_block(view, rules, sums, rows[b]);
  });
}

}  // namespace linprim
