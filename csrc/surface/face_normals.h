// The faces of a triangle mesh: which share a vertex, and their normals, as they are and averaged but for edges.
#pragma once

#include <cstdint>
#include <vector>

#include "base/vector.h"

namespace linprim {

// A mesh and the faces around each of its vertices. `corner` (faces, 3) are rows of `vertex` (vertices, 3).
struct FaceFans {
  int64_t vertices, faces;
  const int64_t* corner;
  std::vector<int64_t> first, face;  // face[first[v]] to face[first[v + 1] - 1] have the vertex v

  FaceFans(int64_t vertices, int64_t faces, const int64_t* corner);

  // Calls body(g) for the faces that share a vertex with f, once per vertex that they share, f among them.
  template <class Body>
  void around(int64_t f, const Body& body) const {
    for (int k = 0; k < 3; ++k) {
      const int64_t v = corner[3 * f + k];
      for (int64_t i = first[v]; i < first[v + 1]; ++i) body(face[i]);
    }
  }
};

struct FaceNormals {
  std::vector<Vector> normal;  // of length 1, 0 of faces without area
  std::vector<double> area;
};

FaceNormals face_normals(const FaceFans& fans, const double* vertex);

// Of each vertex the mean of the normals of its faces, weighted by their angles there, of length 1; 0 without faces.
// Source: Thuermer and Wuethrich 1998.
std::vector<Vector> vertex_normals(const FaceFans& fans, const FaceNormals& faces, const double* vertex);

// The normals after `rounds` in which each becomes the mean of those of the faces around it, weighted by area and
// Tukey's function of their difference: from the length `contrast` on one does not count for another. Source: Zheng et
// al. 2011, with another weight.
std::vector<Vector> average_normals(const FaceFans& fans, const FaceNormals& faces, double contrast, int rounds);

}  // namespace linprim
