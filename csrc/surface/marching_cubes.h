// Marching cubes between the voxels of blocks of several sizes, without cracks.
//
// A voxel has its distance at its centre. The cubes that are marched are those of the dual grid: one per corner of a
// voxel, between the centres of the eight voxels around it. Beside larger voxels some of the eight are the same, and
// what is left of the cube still fits its neighbours (Schaefer and Warren, Dual Marching Cubes: Primal Contouring of
// Dual Grids, 2004). Where all voxels are as large, these are the cubes of a plain grid. The surface is a manifold if
// the levels of blocks that touch differ by one at most; else more than two faces may share an edge, but none is open.
#pragma once

#include <cstdint>
#include <vector>

namespace linprim {

// Blocks of resolution^3 voxels, x fastest, that do not overlap. A voxel of level l is 2^l long; lengths are in finest
// voxels, and block (0, 0, 0) of any level starts at the origin.
struct VoxelBlocks {
  int64_t count;
  int resolution;
  const int64_t* index;   // (count, 3), in blocks of its level
  const int64_t* level;   // (count)
  const float* distance;  // (count, resolution^3), negative inside, never 0
  const uint8_t* known;   // (count, resolution^3); there is no surface beside a voxel that is not
  const uint8_t* owned;   // (count); cubes are marched of which the first of the smallest blocks is
};

struct Triangles {
  std::vector<double> vertex;   // (V, 3)
  std::vector<int64_t> corner;  // (F, 3), counter-clockwise seen from outside
};

constexpr int kMostLevels = 16, kIndexBits = 21;  // block indices are within +-2^(kIndexBits - 1)

// The surface between voxels inside and outside; vertices in the order of the voxels that they lie between. The same
// for any number of threads.
Triangles marching_cubes(const VoxelBlocks& blocks);

}  // namespace linprim
