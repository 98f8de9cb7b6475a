// Votes of one depth map for the voxels of a sparse grid of blocks.
#pragma once

#include <cstdint>

namespace linprim {

// A depth map as planes, one row of kSurfelColumns per pixel. With x in the grid's frame, the signed distance to the
// pixel's surface in truncations, positive on the camera's side, is offset - plane . x.
constexpr int kSurfelColumns = 8;
struct Surfel {
  float plane[3], offset;
  float weight;   // 0: no surface, or one at an unknown place
  float cosine;   // between the pixel's ray and the surface's normal
  float nearest;  // largest 1/z of the pixels around
  float free;     // weight of "the ray passes here"
};

struct SurfelView {
  double project[12];  // grid frame to homogeneous pixels (u z, v z, z), 3 rows of 4
  int width, height;
  const Surfel* surfels;  // (height, width)
};

// How much a vote weighs by its distance from the surfel; lengths in truncations.
struct VoteRules {
  float near;           // before a surface: 1 / (1 + (distance / near)^2),
  float far_front;      // at least this
  float behind;         // behind it: whole this far along the ray, fading over as much again
  float behind_weight;  // what is left of it
  float grazed,
      grazed_reach;     // within the first of the plane and the second along the ray votes hold beyond a truncation,
  float grazed_weight;  // with this weight
  float occluded;       // weight of the vote "inside" of what is further behind
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

// Adds the votes of a view to `count` blocks, `rows` of the sums. The same whatever the number of threads.
void add_votes(const SurfelView& view, const VoteRules& rules, const int64_t* rows, int64_t count,
               const VoxelSums& sums);

}  // namespace linprim
