// Crack-free marching cubes on voxel blocks of several sizes.
//
// A voxel has its distance at its centre. The cubes are those of the dual grid: one per corner of a voxel, between the
// centres of the eight voxels around it. Beside larger voxels some of the eight coincide, and the degenerate cube still
// fits its neighbours (Schaefer and Warren, Dual Marching Cubes: Primal Contouring of Dual Grids, 2004). If all voxels
// have one size, these are the cubes of a plain grid. The surface is a manifold if the levels of blocks that touch
// differ by at most one; otherwise more than two faces may share an edge, but there is no boundary edge.
#pragma once

#include <cstdint>
#include <vector>

namespace linprim {

// Blocks of resolution^3 voxels, x fastest, that do not overlap. A voxel of level l is 2^l long, in finest voxels, the
// unit of all lengths. Block (0, 0, 0) of every level starts at the origin.
struct VoxelBlocks {
  int64_t count;
  int resolution;
  const int64_t* index;   // (count, 3), in blocks of its level
  const int64_t* level;   // (count)
  const float* distance;  // (count, resolution^3), negative inside, never 0
  const uint8_t* known;   // (count, resolution^3); cubes with a voxel that is not known have no surface
  const uint8_t* owned;   // (count); a cube is marched if the first of its smallest blocks is owned
};

struct Triangles {
  std::vector<double> vertex;   // (V, 3)
  std::vector<int64_t> corner;  // (F, 3), counter-clockwise seen from outside
};

constexpr int kMostLevels = 16, kIndexBits = 21;  // block indices are within +-2^(kIndexBits - 1)

// Returns the surface between voxels inside and outside, with vertices sorted by the voxels that they lie between. The
// result is the same for any number of threads.
Triangles marching_cubes(const VoxelBlocks& blocks);

}  // namespace linprim
