// Votes of rays for the tetrahedra that they cross.
#pragma once

#include <cstdint>

namespace linprim {

// A Delaunay triangulation: `corner` (cells, 4) are rows of `point` (.., 3), and `neighbor` (cells, 4) are the cells
// behind the faces opposite to these corners, -1 outside.
struct Cells {
  int64_t cells;
  const double* point;
  const int32_t *corner, *neighbor;
};

// Follows rays that start at the point `start`, a corner of the cells `around`, from cell to cell through the face by
// which a ray leaves each. Each ray of `ray` (rays, 3) adds one vote to every cell that contains a part of it before
// the share `empty` of its length, and subtracts one from the cell at the share `full`, or from `votes[cells]` if that
// is outside; from none if `full` is 0. Float64. The traversal ends for any shape of cells: it visits no more cells
// than there are. Memory: none per ray. The result does not depend on the number of threads.
void vote_for_cells(const Cells& mesh, int32_t start, int64_t around_count, const int32_t* around, int64_t rays,
                    const double* ray, double empty, double full, int64_t* votes);

}  // namespace linprim
