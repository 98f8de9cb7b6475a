// Computations that all primitive kinds need once per primitive and view: pose in camera space, colour, screen bounds;
// and their backward passes.
#pragma once

#include <algorithm>
#include <limits>

#include "base/lanes.h"
#include "primitives/spherical_harmonics.h"

namespace linprim::LINPRIM_ISA {

// Upper limit of densities: opaque over any length that floats resolve, and products with it stay finite.
constexpr double kLargestDensity = 1e20;
// Limits of extents: within them, face planes and squares of depths stay finite in single precision.
constexpr double kSmallestExtent = 1e-15, kLargestExtent = 1e12;
// Slack of screen bounds and silhouette lines in pixels: covers the float rounding of the planes that the tile kernels
// evaluate.
constexpr double kPixelSlack = 1e-3;
// Relative slack of the lower bound of a primitive's depth.
constexpr double kDepthSlack = 1e-5;

// The affine approximation diverges for centres far outside of the image. Therefore x/z and y/z are clamped to the
// image and this share of its size around it, which is 1.3 times half the field of view to either side if the principal
// point is in the middle.
constexpr double kViewMargin = 0.15;
// Upper limit of these slopes, for images whose principal point lies far outside.
constexpr double kLargestSlope = 1e4;
inline D held_in_view(D slope, int pixels, double principal, double focal) {
  const auto limit = [&](double pixel) {
    return std::clamp((pixel - principal) / focal, -kLargestSlope, kLargestSlope);
  };
  return clamp(slope, limit(-kViewMargin * pixels), limit((1 + kViewMargin) * pixels));
}

// Centre and local axes in camera space.
struct Pose {
  D q[4], q_length;  // unit quaternion and the length of the raw one (1 where that is 0)
  B no_rotation;     // raw quaternion of length 0: taken as the identity
  D world[3];        // centre in the world
  D center[3];
  D axis[3][3];  // axis[k]: unit vector of local axis k
};

template <class Real>
inline void set_pose(const View& view, const Primitives<Real>& p, const int64_t* rows, Pose& f) {
  const double* w = view.world_to_camera;
  for (int k = 0; k < 3; ++k) f.world[k] = gather(p.center + k, 3, rows);
  for (int i = 0; i < 3; ++i)
    f.center[i] = w[4 * i] * f.world[0] + w[4 * i + 1] * f.world[1] + w[4 * i + 2] * f.world[2] + w[4 * i + 3];
  D length2{};
  for (int k = 0; k < 4; ++k) {
    f.q[k] = gather(p.rotation + k, 4, rows);
    length2 += f.q[k] * f.q[k];
  }
  f.no_rotation = (B)(length2 == 0.0);
  f.q_length = f.no_rotation ? splat(1.0) : vsqrt(length2);
  const D inverse = 1.0 / f.q_length;
  for (int k = 0; k < 4; ++k) f.q[k] = f.q[k] * inverse;
  f.q[0] = f.no_rotation ? splat(1.0) : f.q[0];
  const D &a = f.q[0], &x = f.q[1], &y = f.q[2], &z = f.q[3];
  const D r[3][3] = {{1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - a * z), 2.0 * (x * z + a * y)},
                     {2.0 * (x * y + a * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - a * x)},
                     {2.0 * (x * z - a * y), 2.0 * (y * z + a * x), 1.0 - 2.0 * (x * x + y * y)}};
  for (int k = 0; k < 3; ++k)
    for (int i = 0; i < 3; ++i) f.axis[k][i] = w[4 * i] * r[0][k] + w[4 * i + 1] * r[1][k] + w[4 * i + 2] * r[2][k];
}

// Converts gradients of the camera-space axes to gradients of the raw quaternion: through R = W^T [axes], the unit
// quaternion and its normalisation.
inline void rotation_grad(const View& view, const Pose& f, const D axis_grad[3][3], D q_grad[4]) {
  const double* w = view.world_to_camera;
  D G[3][3];
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k)
      G[i][k] = w[i] * axis_grad[k][0] + w[4 + i] * axis_grad[k][1] + w[8 + i] * axis_grad[k][2];
  const D &a = f.q[0], &x = f.q[1], &y = f.q[2], &z = f.q[3];
  q_grad[0] = 2.0 * (x * (G[2][1] - G[1][2]) + y * (G[0][2] - G[2][0]) + z * (G[1][0] - G[0][1]));
  q_grad[1] = 2.0 * (-2.0 * x * (G[1][1] + G[2][2]) + y * (G[0][1] + G[1][0]) + z * (G[0][2] + G[2][0]) +
                     a * (G[2][1] - G[1][2]));
  q_grad[2] = 2.0 * (x * (G[0][1] + G[1][0]) - 2.0 * y * (G[0][0] + G[2][2]) + z * (G[1][2] + G[2][1]) +
                     a * (G[0][2] - G[2][0]));
  q_grad[3] = 2.0 * (x * (G[0][2] + G[2][0]) + y * (G[1][2] + G[2][1]) - 2.0 * z * (G[0][0] + G[1][1]) +
                     a * (G[1][0] - G[0][1]));
  const D radial = q_grad[0] * a + q_grad[1] * x + q_grad[2] * y + q_grad[3] * z, inverse = 1.0 / f.q_length;
  for (int k = 0; k < 4; ++k) q_grad[k] = f.no_rotation ? splat(0.0) : (q_grad[k] - radial * f.q[k]) * inverse;
}

// The camera's centre in the world.
struct Eye {
  double at[3];
  explicit Eye(const View& view) {
    const double* w = view.world_to_camera;
    for (int i = 0; i < 3; ++i) at[i] = -(w[i] * w[3] + w[4 + i] * w[7] + w[8 + i] * w[11]);
  }
};

// Computes the unit vector from the camera to the centre (0 where they coincide) and the inverse of their distance.
inline void view_direction(const Eye& eye, const Pose& f, D direction[3], D& inverse) {
  D length2{};
  for (int i = 0; i < 3; ++i) {
    direction[i] = f.world[i] - eye.at[i];
    length2 += direction[i] * direction[i];
  }
  inverse = 1.0 / vsqrt(length2 == 0.0 ? splat(1.0) : length2);
  for (int i = 0; i < 3; ++i) direction[i] *= inverse;
}

// A colour padded to four values, so that it is loaded at once.
template <class Real>
struct Rgb {
  typedef Real Four __attribute__((vector_size(4 * sizeof(Real))));
  static Four load(const Real* p) {  // reads the first value of the next colour too
    Four v;
    std::memcpy(&v, p, sizeof v);
    return v;
  }
  static Four load_last(const Real* p) { return Four{p[0], p[1], p[2], 0}; }
};
// Values of all lanes, narrowed to Real.
template <class Real>
struct Narrow {
  typedef Real Row __attribute__((vector_size(kLanes * sizeof(Real))));
  static void store(Real* to, D value) {
    const Row row = __builtin_convertvector(value, Row);
    std::memcpy(to, &row, sizeof row);
  }
};

// Writes rgb = max(0, 0.5 + sum_i basis_i(direction) sh_i) of the visible lanes to `color` and, `stride` apart, to
// `record`. A colour that is not finite is passed on unchanged, so that the caller can detect it.
template <class Real>
inline void evaluate_color(const Eye& eye, const Pose& f, const Primitives<Real>& p, int64_t first, int lanes,
                           B visible, Real* color, Real* record, int64_t stride) {
  typedef typename Rgb<Real>::Four Four;
  D direction[3], inverse, basis[kMaxShCoefficients];
  view_direction(eye, f, direction, inverse);
  const int count = p.sh_count;
  sh_basis(count, direction[0], direction[1], direction[2], basis);
  Real at[kMaxShCoefficients][kLanes];
  for (int i = 0; i < count; ++i) Narrow<Real>::store(at[i], basis[i]);
  for (int l = 0; l < lanes; ++l) {
    if (!visible[l]) continue;
    const Real* sh = p.sh + (first + l) * count * 3;
    const int last = count - 1;
    Four even{Real(0.5), Real(0.5), Real(0.5), 0}, odd = at[last][l] * Rgb<Real>::load_last(sh + 3 * last);
    int i = 0;
    for (; i + 2 <= last; i += 2)
      even += at[i][l] * Rgb<Real>::load(sh + 3 * i), odd += at[i + 1][l] * Rgb<Real>::load(sh + 3 * i + 3);
    if (i < last) even += at[i][l] * Rgb<Real>::load(sh + 3 * i);
    const Four rgb = even + odd;
    for (int k = 0; k < 3; ++k)
      record[l * stride + k] = color[3 * (first + l) + k] = std::isfinite(rgb[k]) ? std::max(rgb[k], Real(0)) : rgb[k];
  }
}

// Backward pass of the colour for one lane: from the gradient to the colour to those of the coefficients (written) and
// of the centre in the world (added).
template <class Real>
struct ColorAdjoint {
  D direction[3], inverse;
  Real basis[kMaxShCoefficients][kLanes], slope[kMaxShCoefficients][3][kLanes];
  ColorAdjoint(const Eye& eye, const Pose& f, int count) {
    D b[kMaxShCoefficients], s[kMaxShCoefficients][3];
    view_direction(eye, f, direction, inverse);
    sh_basis(count, direction[0], direction[1], direction[2], b);
    sh_basis_grad(count, direction[0], direction[1], direction[2], s);
    for (int i = 0; i < count; ++i) {
      Narrow<Real>::store(basis[i], b[i]);
      for (int t = 0; t < 3; ++t) Narrow<Real>::store(slope[i][t], s[i][t]);
    }
  }
  void add(const Primitives<Real>& p, int64_t row, int l, const Real* color, const double* rgb_sums, Real* sh_grad,
           double world_grad[3]) const {
    typedef typename Rgb<Real>::Four Four;
    const int last = p.sh_count - 1;
    const Real* sh = p.sh + row * p.sh_count * 3;
    const Four g{color[3 * row] > 0 ? Real(rgb_sums[0]) : Real(0), color[3 * row + 1] > 0 ? Real(rgb_sums[1]) : Real(0),
                 color[3 * row + 2] > 0 ? Real(rgb_sums[2]) : Real(0), 0};
    Four along[3] = {};
    for (int i = 0; i < last; ++i) {
      const Four to = basis[i][l] * g, c = Rgb<Real>::load(sh + 3 * i);
      std::memcpy(sh_grad + 3 * i, &to, sizeof to);  // the fourth is written over by the next
      for (int t = 0; t < 3; ++t) along[t] += slope[i][t][l] * c;
    }
    const Four to = basis[last][l] * g, c = Rgb<Real>::load_last(sh + 3 * last);
    for (int k = 0; k < 3; ++k) sh_grad[3 * last + k] = to[k];
    double to_direction[3], radial = 0;
    for (int t = 0; t < 3; ++t) {
      const Four all = (along[t] + slope[last][t][l] * c) * g;
      to_direction[t] = double(all[0]) + double(all[1]) + double(all[2]);
      radial += to_direction[t] * direction[t][l];
    }
    for (int t = 0; t < 3; ++t) world_grad[t] += (to_direction[t] - radial * direction[t][l]) * inverse[l];
  }
};

// Sets the inclusive box of pixels around [low, high], in pixel indices (pixel j has its centre at j). Lanes without a
// pixel of the image are removed from `visible`.
inline void set_boxes(const View& view, D low_x, D high_x, D low_y, D high_y, int lanes, B& visible, Footprint* print) {
  const B x0 = ceil_of(clamp(low_x - kPixelSlack, 0.0, 1e9)),
          x1 = floor_of(clamp(high_x + kPixelSlack, -1.0, view.width - 1.0));
  const B y0 = ceil_of(clamp(low_y - kPixelSlack, 0.0, 1e9)),
          y1 = floor_of(clamp(high_y + kPixelSlack, -1.0, view.height - 1.0));
  visible = visible & (B)(x0 <= x1) & (B)(y0 <= y1);
  for (int l = 0; l < lanes; ++l) {
    print[l].x0 = visible[l] ? int(x0[l]) : 0, print[l].x1 = visible[l] ? int(x1[l]) : -1;
    print[l].y0 = int(y0[l]), print[l].y1 = int(y1[l]);
  }
}

// Sets `count` of 6 half-planes a + b x + c y > 0 with their slack; the others contain everything. x and y are relative
// to the reference pixel.
inline void set_lines(const D* a, const D* b, const D* c, int count, int lanes, Footprint* print) {
  constexpr int kRow = sizeof(Footprint) / sizeof(float);
  D line[18];
  for (int e = 0; e < 6; ++e) {
    line[e] = splat(1.0), line[6 + e] = line[12 + e] = splat(0.0);
    if (e >= count) continue;
    line[e] = a[e] + double(kBlock - 1) * (vmax(b[e], D{}) + vmax(c[e], D{})) +
              kPixelSlack * (vabs(b[e]) + vabs(c[e])) + 1e-6 * vabs(a[e]);
    line[6 + e] = b[e], line[12 + e] = c[e];
  }
  to_rows(&print[0].a[0], kRow, line, 18, lanes);
}

template <class Real>
inline void zero_row(const PrimitiveGradients<Real>& out, int64_t row, int extents, int sh_count) {
  for (int k = 0; k < 3; ++k) out.center[3 * row + k] = out.screen[3 * row + k] = 0;
  for (int k = 0; k < extents; ++k) out.extent[extents * row + k] = 0;
  for (int k = 0; k < 4; ++k) out.rotation[4 * row + k] = 0;
  out.density[row] = 0;
  std::memset(out.sh + row * sh_count * 3, 0, sizeof(Real) * sh_count * 3);
}

// Sums the gradient slots of each lane's primitive; rows without a slot are written as zero. Returns whether any lane
// has one.
template <class Real>
inline bool gather_sums(const ProjectBackwardParams<Real>& P, int64_t first, int lanes, double (*sums)[kGeometrySums]) {
  bool found = false;
  for (int l = 0; l < lanes; ++l) {
    const uint32_t count = P.slot_count[first + l];
    const Real* slot = P.sums + int64_t(P.first_slot[first + l]) * P.sums_per_slot;
    for (int t = 0; t < kGeometrySums; ++t) sums[l][t] = 0;
    for (uint32_t s = 0; s < count; ++s, slot += P.sums_per_slot)
      for (int t = 0; t < P.sums_per_slot; ++t) sums[l][t] += double(slot[t]);
    found |= count != 0;
    if (!count) zero_row(P.out, first + l, P.primitives.extents(), P.primitives.sh_count);
  }
  return found;
}

// Clamps a gradient to the range of Real.
template <class Real>
inline Real saturated(double x) {
  constexpr double kMost = double(std::numeric_limits<Real>::max());
  return Real(std::clamp(x, -kMost, kMost));
}

// Gradients in camera space, which the backward functions convert and write to the rows of the visible lanes.
struct RowGradients {
  D center[3];   // camera space
  D axis[3][3];  // of the unit axes, camera space
  D extent[4];
  D density;             // of the density as given
  D screen_x, screen_y;  // of the projected centre, pixels
};
template <class Real>
inline void write_rows(const ProjectBackwardParams<Real>& P, const Eye& eye, const Pose& f, const RowGradients& g,
                       int64_t first, int lanes, const double (*sums)[kGeometrySums], const double* pull) {
  const double* w = P.view.world_to_camera;
  const int extents = P.primitives.extents(), sh_count = P.primitives.sh_count;
  D q_grad[4], world[3];
  rotation_grad(P.view, f, g.axis, q_grad);
  for (int i = 0; i < 3; ++i) world[i] = w[i] * g.center[0] + w[4 + i] * g.center[1] + w[8 + i] * g.center[2];
  const ColorAdjoint<Real> color(eye, f, sh_count);
  for (int l = 0; l < lanes; ++l) {
    const int64_t row = first + l;
    if (P.slot_count[row] == 0) continue;
    double center[3] = {world[0][l], world[1][l], world[2][l]};
    color.add(P.primitives, row, l, P.color, sums[l] + Sum::rgb, P.out.sh + row * sh_count * 3, center);
    for (int i = 0; i < 3; ++i) P.out.center[3 * row + i] = saturated<Real>(center[i]);
    for (int k = 0; k < extents; ++k) P.out.extent[extents * row + k] = saturated<Real>(g.extent[k][l]);
    for (int k = 0; k < 4; ++k) P.out.rotation[4 * row + k] = saturated<Real>(q_grad[k][l]);
    P.out.screen[3 * row] = saturated<Real>(g.screen_x[l]), P.out.screen[3 * row + 1] = saturated<Real>(g.screen_y[l]);
    P.out.screen[3 * row + 2] = saturated<Real>(pull[l]);
    const double density = double(P.primitives.density[row]);
    P.out.density[row] = density < 0 || density > kLargestDensity ? Real(0) : saturated<Real>(g.density[l]);
  }
}

}  // namespace linprim::LINPRIM_ISA
