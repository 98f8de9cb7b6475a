// Fewer triangles that keep within a tolerance of a mesh.
#pragma once

#include <cstdint>
#include <vector>

#include "surface/marching_cubes.h"

namespace linprim {

// The mesh after edges were collapsed, the cheapest first, as long as every vertex of the mesh that was given stays
// within its tolerance of the surface, and every vertex of a border within it of a border.
//
// The cost of a collapse is the squared distance of the new vertex from the planes of all faces that went into it, by
// area and in tolerances (Garland and Heckbert 1997). Vertices that are gone are kept with the face that is nearest to
// them, and measured again when that face changes (Hoppe 1996), so the bound is on distances, not on the cost. Borders
// stay where they were, and so does the topology: no edge gets more faces, no piece or hole disappears. Faces are
// turned by less than 60 degrees in one step, and angles below 10 degrees do not become smaller. Around edges of more
// than two faces, and where fans of faces touch in a vertex alone, everything stays.
//
// `corner` (faces, 3) are rows of `vertex` (vertices, 3), `tolerance` (vertices) is positive. One thread.
Triangles simplify(int64_t vertices, int64_t faces, const double* vertex, const int64_t* corner,
                   const double* tolerance);

}  // namespace linprim
