// Finds the points within convex polyhedra.
#pragma once

#include <cstdint>
#include <vector>

namespace linprim {

struct ConvexBodies {
  int64_t count;
  int faces;
  const double* center;  // (count, 3)
  const double* normal;  // (count, faces, 3) outward
  const double* offset;  // (count, faces) distances of the faces from the centre, not negative
};

// Returns for each body the sorted rows of the points within it once it is scaled by `enlarged` about its centre; none
// if fewer than `least` points lie within the unscaled body. Points are finite.
std::vector<std::vector<int64_t>> points_within(const ConvexBodies& bodies, const double* point, int64_t count,
                                                double enlarged, int64_t least);

}  // namespace linprim
