// Simplifies a triangle mesh within a distance tolerance.
#pragma once

#include <cstdint>
#include <vector>

#include "surface/marching_cubes.h"

namespace linprim {

// Collapses edges, the cheapest first, as long as every vertex of the given mesh stays within its tolerance of the
// surface, and every boundary vertex within it of a boundary.
//
// The cost of a collapse is the squared distance of the new vertex from the planes of all faces that were merged into
// it, weighted by area and in units of the tolerance (Garland and Heckbert 1997). Removed vertices are kept with the
// face nearest to them, and measured again when that face changes (Hoppe 1996), so the bound is on distances, not on
// the cost. Boundaries stay in place within the tolerance, and the topology stays: no edge gets more faces, no
// component or hole disappears. Faces turn by less than 60 degrees in one step, and angles below 10 degrees do not
// become smaller. Nothing changes around edges of more than two faces, and around vertices in which separate fans of
// faces touch.
//
// `corner` (faces, 3) are rows of `vertex` (vertices, 3), `tolerance` (vertices) is positive. One thread.
Triangles simplify(int64_t vertices, int64_t faces, const double* vertex, const int64_t* corner,
                   const double* tolerance);

}  // namespace linprim
