// Where a triangle mesh goes through itself.
#pragma once

#include <cstdint>
#include <vector>

namespace linprim {

// Faces and the edges that go through them, by the numbers of the edges in order, then of the faces.
struct Crossings {
  std::vector<int64_t> face, edge;
};

// Of `edges` segments with their `end` (edges, 2), the faces with which they share no vertex and whose inside they go
// through: the signs of the volumes of tetrahedra in float64 decide (Segura and Feito 2001). Faces that only touch, lie
// in one plane, both up to rounding, or have no area are crossed by nothing. `corner` (faces, 3) and `end` are rows of
// `vertex` (vertices, 3), which are finite. Memory: 120 bytes per face. The same for any number of threads.
Crossings crossings(int64_t vertices, const double* vertex, int64_t faces, const int64_t* corner, int64_t edges,
                    const int64_t* end);

}  // namespace linprim
