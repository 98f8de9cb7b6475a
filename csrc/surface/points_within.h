// Which of many points lie within convex polyhedra.
#pragma once

#include <cstdint>
#include <vector>

namespace linprim {

struct ConvexBodies {
  int64_t count;
  int faces;
  const double* center;  // (count, 3)
  const double* normal;  // (count, faces, 3) outward
  const double* offset;  // (count, faces) of the faces from the centre, not negative
};

// For each body the rows, in order, of the points within it when it is `enlarged` times as large about its centre; none
// if fewer than `least` lie within the body as it is. Points are finite.
std::vector<std::vector<int64_t>> points_within(const ConvexBodies& bodies, const double* point, int64_t count,
                                                double enlarged, int64_t least);

}  // namespace linprim
