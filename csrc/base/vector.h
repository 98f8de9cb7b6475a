// Vectors of three coordinates.
#pragma once

#include <array>
#include <cmath>

namespace linprim {

using Vector = std::array<double, 3>;

inline double dot(const Vector& a, const Vector& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

inline Vector minus(const Vector& a, const Vector& b) { return {a[0] - b[0], a[1] - b[1], a[2] - b[2]}; }

inline Vector cross(const Vector& a, const Vector& b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

// Adds `factor` b to a.
inline void add(Vector& a, double factor, const Vector& b) {
  for (int axis = 0; axis < 3; ++axis) a[axis] += factor * b[axis];
}

// Normalises to length 1; 0 stays 0. Returns the original length.
inline double normalize(Vector& v) {
  const double length = std::sqrt(dot(v, v));
  if (length > 0)
    for (double& x : v) x /= length;
  return length;
}

}  // namespace linprim
