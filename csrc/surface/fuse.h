// Integrates one depth map into the signed distance field of a sparse voxel grid, by a vote per voxel.
#pragma once

#include <cstdint>

namespace linprim {

// A surfel: the plane of one pixel of a depth map, a row of kSurfelColumns numbers. For x in the grid's frame, the
// signed distance to the pixel's surface in truncations, positive on the camera's side, is offset - plane . x.
constexpr int kSurfelColumns = 8;
struct Surfel {
  float plane[3], offset;
  float weight;   // 0: no surface, or one at an unknown depth
  float cosine;   // between the pixel's ray and the surface's normal
  float nearest;  // largest 1/z of the pixels around
  float free;     // weight of a vote for free space
};

struct SurfelView {
  double project[12];  // grid frame to homogeneous pixels (u z, v z, z), 3 rows of 4
  int width, height;
  const Surfel* surfels;  // (height, width)
};

// Weight of a vote by the voxel's distance from the surfel; lengths in truncations.
struct VoteRules {
  float near;           // in front of the surface: 1 / (1 + (distance / near)^2),
  float far_front;      // at least this
  float behind;         // behind it: full up to this distance along the ray, fades over as much again
  float behind_weight;  // least weight behind it, up to the truncation
  float grazed,
      grazed_reach;     // behind it beyond a truncation, within the first of the plane and the second along the ray:
  float grazed_weight;  // this weight
  float occluded;       // weight of the vote "inside" farther behind
};

// Blocks of resolution^3 voxels, x fastest. Sums are (blocks, resolution^3).
struct VoxelSums {
  const double* corner;  // (blocks, 3) position of the first voxel
  double voxel;
  int resolution;
  float* total;  // weight times signed distance, clamped to a truncation
  float* weight;
  float* free;
};

// Adds the votes of a view to the `count` blocks that are `rows` of the sums. The result is the same for any number of
// threads.
void add_votes(const SurfelView& view, const VoteRules& rules, const int64_t* rows, int64_t count,
               const VoxelSums& sums);

}  // namespace linprim
