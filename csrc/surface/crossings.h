// Self-intersections of a triangle mesh.
#pragma once

#include <cstdint>
#include <vector>

namespace linprim {

// Pierced faces and the edges that pierce them, sorted by edge, then by face.
struct Crossings {
  std::vector<int64_t> face, edge;
};

// Tests `edges` segments with ends `end` (edges, 2) against all faces with which they share no vertex, by the signs of
// tetrahedron volumes in float64 (Segura and Feito 2001). Faces that only touch or are coplanar, both up to rounding,
// or that have no area, are never pierced. `corner` (faces, 3) and `end` are rows of `vertex` (vertices, 3), which are
// finite. Memory: 120 bytes per face. The result is the same for any number of threads.
Crossings crossings(int64_t vertices, const double* vertex, int64_t faces, const int64_t* corner, int64_t edges,
                    const int64_t* end);

}  // namespace linprim
