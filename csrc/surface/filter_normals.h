// Smooths a mesh by its normals: flat parts become flat, edges stay.
//
// Source: Zheng et al. 2011 (bilateral filter of the normals of faces, here with Tukey's weight, whose edge at
// `contrast` keeps faces of different planes apart), Sun et al. 2007 (vertices out of normals).
#pragma once

#include <cstdint>

namespace linprim {

struct NormalFilter {
  double contrast;    // length of the difference of two unit normals from which on one face does not count for another
  int normal_rounds;  // each averages over the faces that share a vertex
  int vertex_rounds;  // each moves vertices towards the planes of their faces
};

// Moves `vertex` (vertices, 3), none farther from where it was than `bound` (vertices). `corner` (faces, 3) are rows of
// it. Faces without area count for nothing. Memory: about 80 bytes per face and 40 per vertex. The same bits for any
// number of threads.
void filter_normals(const NormalFilter& how, int64_t vertices, int64_t faces, const int64_t* corner,
                    const double* bound, double* vertex);

}  // namespace linprim
