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
    const Vector a = at(corner[0]), u = minus(at(corner[1]), a), v = minus(at(corner[2]), a);
    out.normal[f] = {u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]};
    out.area[f] = 0.5 * normalize(out.normal[f]);
  });
  return out;
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
