// Smooths a mesh by filtering its face normals: flat parts become flat, edges stay.
//
// Source: Zheng et al. 2011 (bilateral filter of face normals, here with Tukey's weight, which is 0 from `contrast` on
// and so keeps faces of different planes apart), Sun et al. 2007 (vertex update from normals).
#pragma once

#include <cstdint>

namespace linprim {

struct NormalFilter {
  double contrast;    // length of the difference of two unit normals from which on faces are not averaged
  int normal_rounds;  // rounds of averaging over the faces that share a vertex
  int vertex_rounds;  // rounds of moving vertices towards the planes of their faces
};

// Moves `vertex` (vertices, 3), none farther than `bound` (vertices) from where it was. `corner` (faces, 3) are rows of
// it. Faces without area have no weight. Memory: about 80 bytes per face and 40 per vertex. The result is identical for
// any number of threads.
void filter_normals(const NormalFilter& how, int64_t vertices, int64_t faces, const int64_t* corner,
                    const double* bound, double* vertex);

}  // namespace linprim
