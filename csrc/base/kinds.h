// The kinds of primitives and their properties outside of the kernels. To add a kind, add an enumerator, a row of
// kKindTraits, and a row of the table in raster/kernels.cpp.
#pragma once

#include <algorithm>
#include <cmath>

namespace linprim {

// The numbers are used in Python too, whose `KINDS` has the same order.
enum class PrimitiveKind : int { kOctahedron, kTetrahedron, kGaussian };
constexpr int kKinds = 3;

// A polyhedron about its centre, as the intersection of four slabs |normal . x + shift| <= 1, and its axis-aligned box.
struct Slabs {
  double normal[4][3], shift[4], low[3], high[3];
};

// sum_k s_k (R^T x)_k / extent_k| <= 1 for four sign patterns s, one of each pair of opposite ones.
inline void octahedron_slabs(const double r[3][3], const double* extent, Slabs& out) {
  constexpr double kSigns[4][3] = {{1, 1, 1}, {1, 1, -1}, {1, -1, 1}, {-1, 1, 1}};
  for (int i = 0; i < 3; ++i) {
    double half = 0;
    for (int k = 0; k < 3; ++k) half = std::max(half, std::abs(r[i][k]) * extent[k]);
    out.low[i] = -half, out.high[i] = half;
    for (int j = 0; j < 4; ++j) {
      out.normal[j][i] = 0;
      for (int k = 0; k < 3; ++k) out.normal[j][i] += kSigns[j][k] * r[i][k] / extent[k];
    }
  }
  for (double& s : out.shift) s = 0;
}

// Barycentric coordinates l_j of p = sum_j l_j e_j b_j, where b_i . b_j = -1/3 and sum b_j = 0: with m_j = l_j e_j and
// M their sum, p . b_j = (4 m_j - M) / 3, so m_j = (3 p . b_j + M) / 4, and sum l_j = 1 gives M = (4 - 3 p . sum_i b_i
// / e_i) / sum_i 1 / e_i. The slabs are |2 l_j - 1| <= 1.
inline void tetrahedron_slabs(const double r[3][3], const double* extent, Slabs& out) {
  const double u = 1 / std::sqrt(3.0), b[4][3] = {{u, u, u}, {u, -u, -u}, {-u, u, -u}, {-u, -u, u}};
  double inverses = 0, w[3] = {0, 0, 0};
  for (int j = 0; j < 4; ++j) {
    inverses += 1 / extent[j];
    for (int k = 0; k < 3; ++k) w[k] += b[j][k] / extent[j];
  }
  for (int j = 0; j < 4; ++j) {
    double local[3];
    for (int k = 0; k < 3; ++k) local[k] = 1.5 * (b[j][k] - w[k] / inverses) / extent[j];
    for (int i = 0; i < 3; ++i) out.normal[j][i] = r[i][0] * local[0] + r[i][1] * local[1] + r[i][2] * local[2];
    out.shift[j] = 2 / (inverses * extent[j]) - 1;
  }
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 4; ++j) {
      const double arm = extent[j] * (r[i][0] * b[j][0] + r[i][1] * b[j][1] + r[i][2] * b[j][2]);
      out.low[i] = j ? std::min(out.low[i], arm) : arm, out.high[i] = j ? std::max(out.high[i], arm) : arm;
    }
  }
}

struct KindTraits {
  // Number of extents: half-axes, vertex distances or standard deviations.
  int extents;
  // Computes its faces from positive extents and the local axes in the columns of r; null for kinds without faces.
  void (*slabs)(const double r[3][3], const double* extent, Slabs& out);
};
// In the order of PrimitiveKind.
constexpr KindTraits kKindTraits[kKinds] = {{3, octahedron_slabs}, {4, tetrahedron_slabs}, {3, nullptr}};

constexpr const KindTraits& traits_of(PrimitiveKind kind) { return kKindTraits[int(kind)]; }
// Whether the kind has faces, where rays enter and leave.
constexpr bool is_solid(PrimitiveKind kind) { return traits_of(kind).slabs != nullptr; }

}  // namespace linprim
