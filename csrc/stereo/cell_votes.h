// Votes of rays for the tetrahedra that they cross.
#pragma once

#include <cstdint>

namespace linprim {

// Tetrahedra that fill the hull of points: `corner` (cells, 4) are rows of `point` (.., 3), and `neighbor` (cells, 4)
// are the cells behind the faces opposite to these corners, -1 outside.
struct Cells {
  int64_t cells;
  const double* point;
  const int32_t *corner, *neighbor;
};

// Walks along rays that start at the point `start`, a corner of the cells `around`, from one cell to the next through
// the face that a ray leaves it by. Each ray (rays, 3) adds one vote to every cell that has a part of it before the
// share `empty` of its length, and takes one from the cell at the share `full`, `votes[cells]` if that is outside; from
// none if `full` is 0. Float64. Whatever cells look like a walk ends: it goes through no more of them than there are.
// Memory: none per ray. The same for any number of threads.
void vote_for_cells(const Cells& mesh, int32_t start, int64_t around_count, const int32_t* around, int64_t rays,
                    const double* ray, double empty, double full, int64_t* votes);

}  // namespace linprim
