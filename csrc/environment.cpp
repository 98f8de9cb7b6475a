#include "environment.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "parallel.h"

namespace linprim {
namespace {

// Samples that are kept at once, of 64 bytes.
constexpr int64_t kSamplesAtOnce = 65536;

// The four texels round a direction and their weights.
struct Sample {
  int64_t texel[4];  // index of the first channel
  double weight[4];
};

int face_of(const double* d) {
  const double x = std::abs(d[0]), y = std::abs(d[1]), z = std::abs(d[2]);
  const int axis = x >= y && x >= z ? 0 : y >= z ? 1 : 2;
  return 2 * axis + (d[axis] < 0);
}

// Coordinates along the columns and rows of a face, -1 to 1 within it.
void on_face(int face, const double* d, double& column, double& row) {
  const int axis = face / 2;
  const double along = std::abs(d[axis]);
  column = d[(axis + 1) % 3] / along, row = d[(axis + 2) % 3] / along;
}

int64_t texel_index(int size, int face, int row, int column) { return ((int64_t(face) * size + row) * size + column) * 3; }

// The texel of a face's lattice, which goes on by one beyond its border: there it is the nearest one of the neighbouring face.
int64_t texel_at(int size, int face, int row, int column) {
  if (row >= 0 && row < size && column >= 0 && column < size) return texel_index(size, face, row, column);
  const int axis = face / 2;
  double d[3];
  d[axis] = face % 2 ? -1 : 1;
  d[(axis + 1) % 3] = 2 * (column + 0.5) / size - 1, d[(axis + 2) % 3] = 2 * (row + 0.5) / size - 1;
  const int other = face_of(d);
  double u, v;
  on_face(other, d, u, v);
  const auto nearest = [size](double x) { return std::clamp(int((x + 1) / 2 * size), 0, size - 1); };
  return texel_index(size, other, nearest(v), nearest(u));
}

Sample sample(const DirectionView& view, int size, int row, int column) {
  const double x = (column + 0.5 - view.cx) / view.fx, y = (row + 0.5 - view.cy) / view.fy;
  double d[3];
  for (int a = 0; a < 3; ++a) d[a] = view.rotation[a] * x + view.rotation[3 + a] * y + view.rotation[6 + a];
  const int face = face_of(d);
  double u, v;
  on_face(face, d, u, v);
  u = (u + 1) / 2 * size - 0.5, v = (v + 1) / 2 * size - 0.5;
  const int left = int(u + 1) - 1, top = int(v + 1) - 1;  // rounded down, for both are above -1
  const double a = u - left, b = v - top;
  Sample result{{}, {(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b}};
  if (left >= 0 && top >= 0 && left + 1 < size && top + 1 < size) {
    const int64_t first = texel_index(size, face, top, left), below = first + int64_t(3) * size;
    result.texel[0] = first, result.texel[1] = first + 3, result.texel[2] = below, result.texel[3] = below + 3;
  } else {
    for (int k = 0; k < 4; ++k) result.texel[k] = texel_at(size, face, top + k / 2, left + k % 2);
  }
  return result;
}

}  // namespace

template <class Real>
void add_environment(const DirectionView& view, const CubeMap<Real>& map, double least, const Real* opacity, Real* rgb) {
  const int64_t pixels = int64_t(view.width) * view.height;
  parallel_for(view.height, [&](int64_t row, int) {
    for (int column = 0; column < view.width; ++column) {
      const int64_t pixel = row * view.width + column;
      const double left = 1 - double(opacity[pixel]);
      if (!(left >= least)) continue;
      const Sample s = sample(view, map.size, int(row), column);
      for (int c = 0; c < 3; ++c) {
        double color = 0;
        for (int k = 0; k < 4; ++k) color += s.weight[k] * map.texels[s.texel[k] + c];
        rgb[c * pixels + pixel] += Real(left * color);
      }
    }
  });
}

template <class Real>
void add_environment_grad(const DirectionView& view, const CubeMap<Real>& map, double least, const Real* opacity, const Real* rgb_grad,
                          Real* opacity_grad, Real* map_grad) {
  const int64_t pixels = int64_t(view.width) * view.height;
  std::fill_n(map_grad, int64_t(6) * map.size * map.size * 3, Real(0));
  // Some rows at a time: their samples in parallel, then the sums over texels, which pixels share, in one order.
  const int rows = std::clamp(int(kSamplesAtOnce / view.width), 1, view.height);
  std::vector<Sample> samples(size_t(rows) * view.width);
  for (int top = 0; top < view.height; top += rows) {
    const int count = std::min(rows, view.height - top);
    parallel_for(count, [&](int64_t row, int) {
      for (int column = 0; column < view.width; ++column) {
        const int64_t pixel = (top + row) * view.width + column;
        opacity_grad[pixel] = 0;
        if (!(1 - double(opacity[pixel]) >= least)) continue;
        const Sample s = samples[row * view.width + column] = sample(view, map.size, int(top + row), column);
        double lost = 0;
        for (int c = 0; c < 3; ++c)
          for (int k = 0; k < 4; ++k) lost += s.weight[k] * map.texels[s.texel[k] + c] * rgb_grad[c * pixels + pixel];
        opacity_grad[pixel] = Real(-lost);
      }
    });
    for (int64_t at = 0, pixel = int64_t(top) * view.width; at < int64_t(count) * view.width; ++at, ++pixel) {
      const double left = 1 - double(opacity[pixel]);
      if (!(left >= least)) continue;
      const Sample& s = samples[at];
      const Real grad[3] = {Real(left * rgb_grad[pixel]), Real(left * rgb_grad[pixels + pixel]), Real(left * rgb_grad[2 * pixels + pixel])};
      for (int k = 0; k < 4; ++k)
        for (int c = 0; c < 3; ++c) map_grad[s.texel[k] + c] += Real(s.weight[k]) * grad[c];
    }
  }
}

template void add_environment(const DirectionView&, const CubeMap<float>&, double, const float*, float*);
template void add_environment(const DirectionView&, const CubeMap<double>&, double, const double*, double*);
template void add_environment_grad(const DirectionView&, const CubeMap<float>&, double, const float*, const float*, float*, float*);
template void add_environment_grad(const DirectionView&, const CubeMap<double>&, double, const double*, const double*, double*, double*);

}  // namespace linprim
