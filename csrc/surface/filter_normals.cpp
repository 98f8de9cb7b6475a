#include "surface/filter_normals.h"

#include <vector>

#include "base/parallel.h"
#include "surface/face_normals.h"

namespace linprim {

void filter_normals(const NormalFilter& how, int64_t vertices, int64_t faces, const int64_t* corner,
                    const double* bound, double* vertex) {
  const FaceFans fans(vertices, faces, corner);
  const FaceNormals start_normals = face_normals(fans, vertex);
  const std::vector<double>& area = start_normals.area;
  const std::vector<Vector> normal = average_normals(fans, start_normals, how.contrast, how.normal_rounds);
  const auto at = [&](int64_t v) { return Vector{vertex[3 * v], vertex[3 * v + 1], vertex[3 * v + 2]}; };
  const std::vector<double> start(vertex, vertex + 3 * vertices);
  // Offsets n . x of the faces' planes, which have the filtered normals and go through the centroids.
  std::vector<double> offset(faces);
  for (int round = 0; round < how.vertex_rounds; ++round) {
    for_rows(faces, [&](int64_t f) {
      const Vector a = at(corner[3 * f]), b = at(corner[3 * f + 1]), c = at(corner[3 * f + 2]);
      offset[f] = (dot(normal[f], a) + dot(normal[f], b) + dot(normal[f], c)) / 3;
    });
    // Moves each vertex towards the planes of its faces, by the mean weighted by area, and back to within `bound` of
    // its start.
    for_rows(vertices, [&](int64_t v) {
      const Vector here = at(v);
      Vector move{};
      double total = 0;
      for (int64_t i = fans.first[v]; i < fans.first[v + 1]; ++i) {
        const int64_t f = fans.face[i];
        add(move, area[f] * (offset[f] - dot(normal[f], here)), normal[f]);
        total += area[f];
      }
      if (!(total > 0)) return;
      Vector away;
      for (int axis = 0; axis < 3; ++axis) away[axis] = here[axis] + move[axis] / total - start[3 * v + axis];
      const double length = std::sqrt(dot(away, away)), kept = length > bound[v] ? bound[v] / length : 1;
      for (int axis = 0; axis < 3; ++axis) vertex[3 * v + axis] = start[3 * v + axis] + kept * away[axis];
    });
  }
}

}  // namespace linprim
