// Face adjacency and normals of a triangle mesh: face normals, vertex normals, and edge-preserving averages.
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

  // Calls body(g) for all faces that share a vertex with f, once per shared vertex, f included.
  template <class Body>
  void around(int64_t f, const Body& body) const {
    for (int k = 0; k < 3; ++k) {
      const int64_t v = corner[3 * f + k];
      for (int64_t i = first[v]; i < first[v + 1]; ++i) body(face[i]);
    }
  }
};

struct FaceNormals {
  std::vector<Vector> normal;  // unit length; 0 for faces without area
  std::vector<double> area;
};

FaceNormals face_normals(const FaceFans& fans, const double* vertex);

// Returns per vertex the unit mean of its face normals, weighted by the faces' angles at the vertex; 0 without faces.
// Source: Thuermer and Wuethrich 1998.
std::vector<Vector> vertex_normals(const FaceFans& fans, const FaceNormals& faces, const double* vertex);

// Returns face normals after `rounds` of averaging over the faces that share a vertex, weighted by area and Tukey's
// function of the normals' difference, which is 0 from the length `contrast` on. Source: Zheng et al. 2011, with
// another weight.
std::vector<Vector> average_normals(const FaceFans& fans, const FaceNormals& faces, double contrast, int rounds);

}  // namespace linprim
