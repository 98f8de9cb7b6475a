#include "surface/filter_normals.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "base/parallel.h"

namespace linprim {
namespace {

using Vector = std::array<double, 3>;

constexpr int64_t kRowsPerTask = 4096;

// body(row) for each of `rows`.
template <class Body>
void each(int64_t rows, const Body& body) {
  parallel_for((rows + kRowsPerTask - 1) / kRowsPerTask, [&](int64_t task, int) {
    const int64_t end = std::min((task + 1) * kRowsPerTask, rows);
    for (int64_t row = task * kRowsPerTask; row < end; ++row) body(row);
  });
}

double dot(const Vector& a, const Vector& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// Scaled to length 1; 0 stays 0. Returns the length.
double normalize(Vector& v) {
  const double length = std::sqrt(dot(v, v));
  if (length > 0)
    for (double& x : v) x /= length;
  return length;
}

// The faces around each vertex: face[first[v]] to face[first[v + 1] - 1].
struct Fans {
  std::vector<int64_t> first, face;
  Fans(int64_t vertices, int64_t faces, const int64_t* corner) : first(vertices + 1), face(3 * faces) {
    for (int64_t i = 0; i < 3 * faces; ++i) ++first[corner[i] + 1];
    for (int64_t v = 0; v < vertices; ++v) first[v + 1] += first[v];
    std::vector<int64_t> next(first.begin(), first.end() - 1);
    for (int64_t i = 0; i < 3 * faces; ++i) face[next[corner[i]]++] = i / 3;
  }
};

}  // namespace

void filter_normals(const NormalFilter& how, int64_t vertices, int64_t faces, const int64_t* corner,
                    const double* bound, double* vertex) {
  const Fans fans(vertices, faces, corner);
  const auto at = [&](int64_t v) { return Vector{vertex[3 * v], vertex[3 * v + 1], vertex[3 * v + 2]}; };
  std::vector<Vector> normal(faces), other(faces);
  std::vector<double> area(faces);
  each(faces, [&](int64_t f) {
    const Vector a = at(corner[3 * f]), b = at(corner[3 * f + 1]), c = at(corner[3 * f + 2]);
    const Vector u{b[0] - a[0], b[1] - a[1], b[2] - a[2]}, v{c[0] - a[0], c[1] - a[1], c[2] - a[2]};
    normal[f] = {u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]};
    area[f] = 0.5 * normalize(normal[f]);
  });
  const double scale = 1 / (how.contrast * how.contrast);
  for (int round = 0; round < how.normal_rounds; ++round) {
    each(faces, [&](int64_t f) {
      const Vector n = normal[f];
      Vector sum{};
      for (int k = 0; k < 3; ++k) {
        const int64_t v = corner[3 * f + k];
        for (int64_t i = fans.first[v]; i < fans.first[v + 1]; ++i) {
          const int64_t g = fans.face[i];
          const Vector& m = normal[g];
          // |n - m|^2 = 2 - 2 n . m
          const double near = std::max(0.0, 1 - scale * (2 - 2 * dot(n, m)));
          const double weight = area[g] * near * near;
          for (int axis = 0; axis < 3; ++axis) sum[axis] += weight * m[axis];
        }
      }
      other[f] = normalize(sum) > 0 ? sum : n;
    });
    normal.swap(other);
  }
  const std::vector<double> start(vertex, vertex + 3 * vertices);
  // The planes of faces go through their middles: how far these are ahead along the normals, and times the area.
  std::vector<double> offset(faces);
  for (int round = 0; round < how.vertex_rounds; ++round) {
    each(faces, [&](int64_t f) {
      const Vector a = at(corner[3 * f]), b = at(corner[3 * f + 1]), c = at(corner[3 * f + 2]);
      offset[f] = (dot(normal[f], a) + dot(normal[f], b) + dot(normal[f], c)) / 3;
    });
    each(vertices, [&](int64_t v) {
      const Vector here = at(v);
      Vector move{};
      double total = 0;
      for (int64_t i = fans.first[v]; i < fans.first[v + 1]; ++i) {
        const int64_t f = fans.face[i];
        const double ahead = area[f] * (offset[f] - dot(normal[f], here));
        for (int axis = 0; axis < 3; ++axis) move[axis] += ahead * normal[f][axis];
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
