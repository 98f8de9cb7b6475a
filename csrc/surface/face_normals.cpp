#include "surface/face_normals.h"

#include <algorithm>

#include "base/parallel.h"

namespace linprim {

FaceFans::FaceFans(int64_t vertices, int64_t faces, const int64_t* corner)
    : vertices(vertices), faces(faces), corner(corner), first(vertices + 1), face(3 * faces) {
  for (int64_t i = 0; i < 3 * faces; ++i) ++first[corner[i] + 1];
  for (int64_t v = 0; v < vertices; ++v) first[v + 1] += first[v];
  std::vector<int64_t> next(first.begin(), first.end() - 1);
  for (int64_t i = 0; i < 3 * faces; ++i) face[next[corner[i]]++] = i / 3;
}

FaceNormals face_normals(const FaceFans& fans, const double* vertex) {
  FaceNormals out{std::vector<Vector>(fans.faces), std::vector<double>(fans.faces)};
  const auto at = [&](int64_t v) { return Vector{vertex[3 * v], vertex[3 * v + 1], vertex[3 * v + 2]}; };
  for_rows(fans.faces, [&](int64_t f) {
    const int64_t* corner = fans.corner + 3 * f;
    const Vector a = at(corner[0]);
    out.normal[f] = cross(minus(at(corner[1]), a), minus(at(corner[2]), a));
    out.area[f] = 0.5 * normalize(out.normal[f]);
  });
  return out;
}

std::vector<Vector> vertex_normals(const FaceFans& fans, const FaceNormals& faces, const double* vertex) {
  std::vector<Vector> normal(fans.vertices);
  const auto at = [&](int64_t v) { return Vector{vertex[3 * v], vertex[3 * v + 1], vertex[3 * v + 2]}; };
  for_rows(fans.vertices, [&](int64_t v) {
    for (int64_t i = fans.first[v]; i < fans.first[v + 1]; ++i) {
      const int64_t* corner = fans.corner + 3 * fans.face[i];
      const int k = corner[0] == v ? 0 : corner[1] == v ? 1 : 2;
      Vector there = minus(at(corner[(k + 1) % 3]), at(v)), back = minus(at(corner[(k + 2) % 3]), at(v));
      normalize(there), normalize(back);
      // Half-angle form: accurate for angles near 0 and pi, where the arc cosine is not.
      Vector sum = there;
      add(sum, 1, back), add(there, -1, back);
      add(normal[v], std::atan2(std::sqrt(dot(there, there)), std::sqrt(dot(sum, sum))), faces.normal[fans.face[i]]);
    }
    normalize(normal[v]);
  });
  return normal;
}

std::vector<Vector> average_normals(const FaceFans& fans, const FaceNormals& faces, double contrast, int rounds) {
  std::vector<Vector> normal = faces.normal, other(fans.faces);
  const double scale = 1 / (contrast * contrast);
  for (int round = 0; round < rounds; ++round) {
    for_rows(fans.faces, [&](int64_t f) {
      const Vector n = normal[f];
      Vector sum{};
      fans.around(f, [&](int64_t g) {
        // |n - m|^2 = 2 - 2 n . m
        const double near = std::max(0.0, 1 - scale * (2 - 2 * dot(n, normal[g])));
        add(sum, faces.area[g] * near * near, normal[g]);
      });
      other[f] = normalize(sum) > 0 ? sum : n;
    });
    normal.swap(other);
  }
  return normal;
}

}  // namespace linprim
