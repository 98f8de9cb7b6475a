#include "raster/environment.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "base/parallel.h"

namespace linprim {
namespace {

// Samples that the backward pass buffers at a time, but at least one image row. A sample has at most 32 bytes.
constexpr int64_t kSamplesAtOnce = 65536;

// Position of a direction on the cube map: a face, and coordinates in texels along its columns and rows, 0 at the
// centre of the first texel.
struct Place {
  int face;
  double column, row;
};

// Bilinear sample at a place: the index of the first channel of the four texels around it, left to right and top to
// bottom, and the offset of the place from the first texel, in texels.
template <class Real>
struct Sample {
  int32_t texel[4];
  Real across, down;

  Real weight(int k) const { return (k % 2 ? across : 1 - across) * (k / 2 ? down : 1 - down); }
};

// Projects a direction onto the cube face of its largest coordinate.
inline Place place_of(double dx, double dy, double dz, int size) {
  const double x = std::abs(dx), y = std::abs(dy), z = std::abs(dz);
  const bool first = (x >= y) & (x >= z), second = !first & (y >= z);
  const double along = first ? dx : second ? dy : dz;
  const double across = first ? dy : second ? dz : dx, down = first ? dz : second ? dx : dy;
  const double half = 0.5 * size, scale = half / std::abs(along);
  return {(first    ? 0
           : second ? 2
                    : 4) +
              (along < 0 ? 1 : 0),
          across * scale + (half - 0.5), down * scale + (half - 0.5)};
}

// Returns the index of the first channel of a texel.
int32_t texel_index(int size, int face, int row, int column) { return ((face * size + row) * size + column) * 3; }

// Returns the texel at a row and column of a face. Rows and columns may lie one texel beyond its border: there, the
// nearest texel of the neighbouring face is returned.
int32_t texel_at(int size, int face, int row, int column) {
  if (row >= 0 && row < size && column >= 0 && column < size) return texel_index(size, face, row, column);
  const int axis = face / 2;
  double d[3];
  d[axis] = face % 2 ? -1 : 1;
  d[(axis + 1) % 3] = 2 * (column + 0.5) / size - 1, d[(axis + 2) % 3] = 2 * (row + 0.5) / size - 1;
  const Place other = place_of(d[0], d[1], d[2], size);
  const auto nearest = [size](double x) { return std::clamp(int(x + 0.5), 0, size - 1); };
  return texel_index(size, other.face, nearest(other.row), nearest(other.column));
}

// Returns the texels and offsets for bilinear interpolation at a place.
template <class Real>
Sample<Real> sample(const Place& place, int size) {
  const int left = int(place.column + 1) - 1, top = int(place.row + 1) - 1;  // rounds down, as both are above -1
  Sample<Real> result{{}, Real(place.column - left), Real(place.row - top)};
  if (left >= 0 && top >= 0 && left + 1 < size && top + 1 < size) {
    const int32_t first = texel_index(size, place.face, top, left), below = first + 3 * size;
    result.texel[0] = first, result.texel[1] = first + 3, result.texel[2] = below, result.texel[3] = below + 3;
  } else {
    for (int k = 0; k < 4; ++k) result.texel[k] = texel_at(size, place.face, top + k / 2, left + k % 2);
  }
  return result;
}

// Calls visit(column, sample) for the pixels of an image row whose ray has not ended: 1 - opacity is at least `least`.
// `opacity` points to that row.
template <class Real, class Visit>
void for_each_sample(const DirectionView& view, int size, double least, int row, const Real* opacity,
                     const Visit& visit) {
  constexpr int kAtOnce = 64;
  double columns[kAtOnce], rows[kAtOnce];
  int faces[kAtOnce];
  const double y = (row + 0.5 - view.cy) / view.fy, step = 1 / view.fx;
  const double* r = view.rotation;
  const double p[3] = {r[3] * y + r[6], r[4] * y + r[7], r[5] * y + r[8]};
  for (int first = 0; first < view.width; first += kAtOnce) {
    const int count = std::min(kAtOnce, view.width - first);
    for (int k = 0; k < count; ++k) {
      const double x = (first + k + 0.5 - view.cx) * step;
      const Place place = place_of(r[0] * x + p[0], r[1] * x + p[1], r[2] * x + p[2], size);
      faces[k] = place.face, columns[k] = place.column, rows[k] = place.row;
    }
    for (int k = 0; k < count; ++k)
      if (1 - double(opacity[first + k]) >= least)
        visit(first + k, sample<Real>({faces[k], columns[k], rows[k]}, size));
  }
}

// Accumulates the gradients of pixels into the texels of a map. Consecutive pixels that share all four texels are
// summed first and added to the map together; flush() adds the last such sum.
template <class Real>
class Gathered {
 public:
  explicit Gathered(Real* texels) : texels_(texels) {}

  void add(const Sample<Real>& s, const Real (&color)[3]) {
    if (s.texel[0] != at_[0] || s.texel[1] != at_[1] || s.texel[2] != at_[2] || s.texel[3] != at_[3]) {
      flush();
      std::copy_n(s.texel, 4, at_);
    }
    for (int k = 0; k < 4; ++k)
      for (int c = 0; c < 3; ++c) sum_[k][c] += s.weight(k) * color[c];
  }

  void flush() {
    if (at_[0] < 0) return;
    for (int k = 0; k < 4; ++k)
      for (int c = 0; c < 3; ++c) texels_[at_[k] + c] += sum_[k][c], sum_[k][c] = 0;
  }

 private:
  Real* texels_;
  int32_t at_[4] = {-1, -1, -1, -1};
  Real sum_[4][3] = {};
};

}  // namespace

template <class Real>
void environment_light(const DirectionView& view, const CubeMap<Real>& map, double least, const Real* opacity,
                       Real* light) {
  const int64_t pixels = int64_t(view.width) * view.height;
  std::fill_n(light, 3 * pixels, Real(0));
  parallel_for(view.height, [&](int64_t row, int) {
    const int64_t first = row * view.width;
    for_each_sample(view, map.size, least, int(row), opacity + first, [&](int column, const Sample<Real>& s) {
      const int64_t pixel = first + column;
      const Real left = 1 - opacity[pixel], weight[4] = {s.weight(0), s.weight(1), s.weight(2), s.weight(3)};
      for (int c = 0; c < 3; ++c) {
        Real color = 0;
        for (int k = 0; k < 4; ++k) color += weight[k] * map.texels[s.texel[k] + c];
        light[c * pixels + pixel] = left * color;
      }
    });
  });
}

template <class Real>
void environment_light_grad(const DirectionView& view, int size, double least, const Real* opacity,
                            const Real* light_grad, Real* map_grad) {
  const int64_t pixels = int64_t(view.width) * view.height;
  std::fill_n(map_grad, int64_t(6) * size * size * 3, Real(0));
  // In blocks of rows: computes the samples in parallel, then adds them to the texels, which pixels share, on one
  // thread in a fixed order.
  const int rows = std::clamp(int(kSamplesAtOnce / view.width), 1, view.height);
  std::vector<Sample<Real>> samples(size_t(rows) * view.width);
  for (int top = 0; top < view.height; top += rows) {
    const int count = std::min(rows, view.height - top);
    parallel_for(count, [&](int64_t row, int) {
      for_each_sample(view, size, least, int(top + row), opacity + (top + row) * view.width,
                      [&](int column, const Sample<Real>& s) { samples[row * view.width + column] = s; });
    });
    Gathered<Real> gathered(map_grad);
    for (int64_t at = 0, pixel = int64_t(top) * view.width; at < int64_t(count) * view.width; ++at, ++pixel) {
      if (!(1 - double(opacity[pixel]) >= least)) continue;
      const Real left = 1 - opacity[pixel];
      gathered.add(samples[at], {left * light_grad[pixel], left * light_grad[pixels + pixel],
                                 left * light_grad[2 * pixels + pixel]});
    }
    gathered.flush();
  }
}

template void environment_light(const DirectionView&, const CubeMap<float>&, double, const float*, float*);
template void environment_light(const DirectionView&, const CubeMap<double>&, double, const double*, double*);
template void environment_light_grad(const DirectionView&, int, double, const float*, const float*, float*);
template void environment_light_grad(const DirectionView&, int, double, const double*, const double*, double*);

}  // namespace linprim
