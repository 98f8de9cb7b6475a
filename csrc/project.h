// From primitives to projected records, and the adjoint: gradient sums of a record back to centre, rotation, extent and density.
//
// Everything here is double precision, kLanes primitives at a time. Included by kernels.cpp only.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstring>

#include "kernels.h"
#include "spherical_harmonics.h"

namespace linprim::LINPRIM_ISA {

// A face seen edge-on divides by h = 0; |h| is kept above this part of the largest term in it.
constexpr double kEdgeOn = 1e-6;
// Densities above this, opaque over any length that floats resolve, are taken as this: products with it stay finite.
constexpr double kLargestDensity = 1e20;
// Slack, in pixels, of screen bounds and silhouette lines: covers the float rounding of the planes the tile kernels evaluate.
constexpr double kPixelSlack = 1e-3;

#if defined(LINPRIM_ISA_V4)
constexpr int kLanes = 8;
#elif defined(LINPRIM_ISA_V3)
constexpr int kLanes = 4;
#elif defined(LINPRIM_ISA_SCALAR)
constexpr int kLanes = 1;
#else
constexpr int kLanes = 2;
#endif
typedef double D __attribute__((vector_size(8 * kLanes)));
typedef int64_t B __attribute__((vector_size(8 * kLanes)));  // what a comparison of D gives: all ones or 0 per lane

inline D splat(double x) { return x - D{}; }
inline D vmin(D a, D b) { return a < b ? a : b; }
inline D vmax(D a, D b) { return a > b ? a : b; }
inline D vabs(D a) { return a < 0.0 ? -a : a; }
inline D vsqrt(D a) {
  for (int l = 0; l < kLanes; ++l) a[l] = std::sqrt(a[l]);
  return a;
}

template <class Real>
inline D gather(const Real* base, int64_t stride, const int64_t* rows) {
  D r;
  for (int l = 0; l < kLanes; ++l) r[l] = double(base[rows[l] * stride]);
  return r;
}

// The pose-dependent frame of an octahedron, shared by the projection and its adjoint. Axes are mirrored so that m >= 0, which an
// octahedron does not notice; `flip` undoes it.
struct Frame8 {
  D q[4], q_length;       // unit quaternion and the length of the raw one (1 where that is 0)
  B no_rotation;          // raw quaternion of length 0: taken as the identity
  D center[3];            // camera space
  D axis[3][3];           // axis[k]: unit vector of local axis k, camera space, mirrored
  D extent[3];
  D n[3][3];              // n[k] = axis[k] / extent[k]
  D m[3];                 // n[k] . center >= 0
  D flip[3];
  D rotation[3][3];       // world rotation of the primitive, not mirrored
};

template <class Real>
inline void set_up(const View& view, const Primitives<Real>& p, const int64_t* rows, Frame8& f) {
  const double* w = view.world_to_camera;
  D world[3];
  for (int k = 0; k < 3; ++k) world[k] = gather(p.center + k, 3, rows);
  for (int i = 0; i < 3; ++i) f.center[i] = w[4 * i] * world[0] + w[4 * i + 1] * world[1] + w[4 * i + 2] * world[2] + w[4 * i + 3];
  D length2{};
  for (int k = 0; k < 4; ++k) {
    f.q[k] = gather(p.rotation + k, 4, rows);
    length2 += f.q[k] * f.q[k];
  }
  f.no_rotation = (B)(length2 == 0.0);
  f.q_length = f.no_rotation ? splat(1.0) : vsqrt(length2);
  for (int k = 0; k < 4; ++k) f.q[k] = f.q[k] / f.q_length;
  f.q[0] = f.no_rotation ? splat(1.0) : f.q[0];
  const D &a = f.q[0], &x = f.q[1], &y = f.q[2], &z = f.q[3];
  D(&r)[3][3] = f.rotation;
  r[0][0] = 1.0 - 2.0 * (y * y + z * z), r[0][1] = 2.0 * (x * y - a * z), r[0][2] = 2.0 * (x * z + a * y);
  r[1][0] = 2.0 * (x * y + a * z), r[1][1] = 1.0 - 2.0 * (x * x + z * z), r[1][2] = 2.0 * (y * z - a * x);
  r[2][0] = 2.0 * (x * z - a * y), r[2][1] = 2.0 * (y * z + a * x), r[2][2] = 1.0 - 2.0 * (x * x + y * y);
  for (int k = 0; k < 3; ++k) {
    f.extent[k] = gather(p.extent + k, 3, rows);
    const D inverse = 1.0 / f.extent[k];
    for (int i = 0; i < 3; ++i) f.axis[k][i] = w[4 * i] * r[0][k] + w[4 * i + 1] * r[1][k] + w[4 * i + 2] * r[2][k];
    f.m[k] = (f.axis[k][0] * f.center[0] + f.axis[k][1] * f.center[1] + f.axis[k][2] * f.center[2]) * inverse;
    f.flip[k] = f.m[k] < 0.0 ? splat(-1.0) : splat(1.0);
    f.m[k] = vabs(f.m[k]);
    for (int i = 0; i < 3; ++i) {
      f.axis[k][i] *= f.flip[k];
      f.n[k][i] = f.axis[k][i] * inverse;
    }
  }
}

// Signs of the four pairs of opposite faces: pair j is +-(kSign[j][0], kSign[j][1], kSign[j][2]).
constexpr double kSign[4][3] = {{1, 1, 1}, {1, 1, -1}, {1, -1, 1}, {-1, 1, 1}};

inline void pair_sums(const D v[3], D out[4]) {
  out[0] = v[0] + v[1] + v[2];
  out[1] = v[0] + v[1] - v[2];
  out[2] = v[0] - v[1] + v[2];
  out[3] = v[1] - v[0] + v[2];
}

// The reference that a record's planes are relative to: the pixel nearest to the projected centre and the centre's inverse depth,
// or, for a primitive that crosses the near plane, inverse depth 0 at the principal point.
struct Reference {
  D x, y, w0;
  D base[3];  // v_ref - w0 * center: 0 but for the rounding to a pixel where the reference is the centre
  D z_min, z_max;
  B crosses_near;
};

inline Reference reference_of(const View& view, const Frame8& f) {
  Reference r;
  D reach{};
  for (int k = 0; k < 3; ++k) reach = vmax(reach, vabs(f.axis[k][2] * f.extent[k]));
  r.z_min = f.center[2] - reach;
  r.z_max = f.center[2] + reach;
  r.crosses_near = (B)(r.z_min < view.near);
  const D safe_z = r.crosses_near ? splat(1.0) : f.center[2];
  r.w0 = r.crosses_near ? splat(0.0) : 1.0 / safe_z;
  r.x = r.crosses_near ? splat(std::floor(view.cx)) : view.fx * f.center[0] * r.w0 + (view.cx - 0.5);
  r.y = r.crosses_near ? splat(std::floor(view.cy)) : view.fy * f.center[1] * r.w0 + (view.cy - 0.5);
  for (int l = 0; l < kLanes; ++l) {
    // A reference far outside the image only loses precision where nothing is drawn.
    r.x[l] = std::nearbyint(std::clamp(r.x[l], -4e6, 4e6));
    r.y[l] = std::nearbyint(std::clamp(r.y[l], -4e6, 4e6));
  }
  const D v[3] = {(r.x + (0.5 - view.cx)) * (1.0 / view.fx), (r.y + (0.5 - view.cy)) * (1.0 / view.fy), splat(1.0)};
  for (int i = 0; i < 3; ++i) r.base[i] = v[i] - f.center[i] * r.w0;
  return r;
}

// Silhouette half-planes of one primitive from its own record, for the general path: every edge between a front and a back face.
template <class Real>
inline void silhouette_lines(const Record<Real>& record, const bool front[8], const double signs[8][3], Footprint& out) {
  int count = 0;
  for (int i = 0; i < 8; ++i)
    for (int j = 0; j < 8; ++j) {
      if (!front[i] || front[j] || count == 6) continue;
      int differ = 0;
      for (int k = 0; k < 3; ++k) differ += signs[i][k] != signs[j][k];
      if (differ != 1) continue;
      out.a[count] = float(record.a[i] - record.a[j]);
      out.b[count] = float(record.b[i] - record.b[j]);
      out.c[count] = float(record.c[i] - record.c[j]);
      ++count;
    }
  for (; count < 6; ++count) out.a[count] = 1, out.b[count] = out.c[count] = 0;
}

template <class Real>
void project(const ProjectParams<Real>& P, int64_t begin, int64_t end) {
  const View& view = P.view;
  const double* w2c = view.world_to_camera;
  double eye[3];  // camera centre in the world
  for (int i = 0; i < 3; ++i) eye[i] = -(w2c[i] * w2c[3] + w2c[4 + i] * w2c[7] + w2c[8 + i] * w2c[11]);

  for (int64_t first = begin; first < end; first += kLanes) {
    const int lanes = int(std::min<int64_t>(kLanes, end - first));
    int64_t rows[kLanes];
    for (int l = 0; l < kLanes; ++l) rows[l] = first + std::min(l, lanes - 1);
    Frame8 f;
    set_up(view, P.primitives, rows, f);
    const Reference ref = reference_of(view, f);

    // Screen bounds, in pixel indices (pixel j has its centre at j).
    D lo_x = splat(1e30), hi_x = splat(-1e30), lo_y = lo_x, hi_y = hi_x;
    for (int k = 0; k < 3; ++k)
      for (int side = -1; side <= 1; side += 2) {
        D vertex[3];
        for (int i = 0; i < 3; ++i) vertex[i] = f.center[i] + double(side) * f.axis[k][i] * f.extent[k];
        const D inverse = 1.0 / (ref.crosses_near ? splat(1.0) : vertex[2]);
        const D x = view.fx * vertex[0] * inverse + (view.cx - 0.5), y = view.fy * vertex[1] * inverse + (view.cy - 0.5);
        lo_x = vmin(lo_x, x), hi_x = vmax(hi_x, x), lo_y = vmin(lo_y, y), hi_y = vmax(hi_y, y);
      }
    lo_x = ref.crosses_near ? splat(0.0) : lo_x, hi_x = ref.crosses_near ? splat(1e9) : hi_x;
    lo_y = ref.crosses_near ? splat(0.0) : lo_y, hi_y = ref.crosses_near ? splat(1e9) : hi_y;
    const D smallest = vmin(f.extent[0], vmin(f.extent[1], f.extent[2]));
    B visible = (B)(ref.z_max > view.near) & (B)(smallest > 0.0);
    Footprint* print = P.footprints + first;
    bool any = false;
    for (int l = 0; l < lanes; ++l) {
      print[l].x0 = int(std::ceil(std::clamp(lo_x[l] - kPixelSlack, 0.0, 1e9)));
      print[l].x1 = int(std::floor(std::clamp(hi_x[l] + kPixelSlack, -1.0, view.width - 1.0)));
      print[l].y0 = int(std::ceil(std::clamp(lo_y[l] - kPixelSlack, 0.0, 1e9)));
      print[l].y1 = int(std::floor(std::clamp(hi_y[l] + kPixelSlack, -1.0, view.height - 1.0)));
      if (!(visible[l] && print[l].x0 <= print[l].x1 && print[l].y0 <= print[l].y1)) print[l].x1 = -1, print[l].x0 = 0, visible[l] = 0;
      any |= visible[l] != 0;
      P.depth[first + l] = Real(f.center[2][l]);
      Real* color = P.color + 3 * (first + l);
      color[0] = color[1] = color[2] = 0;
    }
    if (!any) continue;

    // Local forms p_k = n_k . v - m_k w0 at the reference pixel and their steps per pixel, then the faces.
    D p[3], px[3], py[3], q[4], qx[4], qy[4], sigma[4];
    for (int k = 0; k < 3; ++k) {
      p[k] = f.n[k][0] * ref.base[0] + f.n[k][1] * ref.base[1] + f.n[k][2] * ref.base[2];
      px[k] = f.n[k][0] * (1.0 / view.fx);
      py[k] = f.n[k][1] * (1.0 / view.fy);
    }
    pair_sums(p, q), pair_sums(px, qx), pair_sums(py, qy), pair_sums(f.m, sigma);
    D a[8], b[8], c[8], face[3][8], side[4];
    B front[4];
    for (int j = 0; j < 4; ++j) {
      side[j] = sigma[j] > 0.0 ? splat(-1.0) : splat(1.0);
      const D size = vabs(sigma[j]);
      D h = 1.0 - size;
      const D floor = kEdgeOn * (1.0 + size);
      h = vabs(h) < floor ? (h < 0.0 ? -floor : floor) : h;
      front[j] = (B)(h < 0.0);
      const D near_side = 1.0 / h, far_side = 1.0 / (1.0 + size);
      a[j] = (side[j] * q[j] - ref.w0) * near_side, a[4 + j] = (-side[j] * q[j] - ref.w0) * far_side;
      b[j] = side[j] * qx[j] * near_side, b[4 + j] = -side[j] * qx[j] * far_side;
      c[j] = side[j] * qy[j] * near_side, c[4 + j] = -side[j] * qy[j] * far_side;
      for (int k = 0; k < 3; ++k) face[k][j] = kSign[j][k] * side[j] * near_side, face[k][4 + j] = -kSign[j][k] * side[j] * far_side;
    }
    const B all_front = front[0] & front[1] & front[2] & front[3];
    const B general = ~all_front | ref.crosses_near;

    // Silhouette: with m >= 0 at most one of sigma[1..3] is negative. If none is, the silhouette is a hexagon and its edges lie
    // between the face pairs {1,2}, {1,3}, {2,3}; if sigma[k] is, it is a quadrilateral between {0,k} and the other two.
    D line_a[6], line_b[6], line_c[6];
    const B n1 = (B)(sigma[1] <= 0.0), n2 = (B)(sigma[2] <= 0.0), n3 = (B)(sigma[3] <= 0.0);
    auto edges = [&](int slot, int i, int j, B to0i, B to0j) {
      // Pair {i, j}, or {0, i} where to0i, or {0, j} where to0j.
      const D* from[3] = {a, b, c};
      D* to[3] = {line_a, line_b, line_c};
      for (int t = 0; t < 3; ++t) {
        const D* u = from[t];
        const D one = to0i ? u[0] : to0j ? u[0] : u[i], other = to0i ? u[i] : u[j];
        const D one_back = to0i ? u[4] : to0j ? u[4] : u[4 + i], other_back = to0i ? u[4 + i] : u[4 + j];
        to[t][2 * slot] = one - other_back;
        to[t][2 * slot + 1] = other - one_back;
      }
    };
    edges(0, 1, 2, n1, n2);
    edges(1, 1, 3, n1, n3);
    edges(2, 2, 3, n2, n3);

    D basis[kMaxShCoefficients];
    {
      D direction[3], length2{};
      for (int i = 0; i < 3; ++i) {
        direction[i] = gather(P.primitives.center + i, 3, rows) - eye[i];
        length2 += direction[i] * direction[i];
      }
      const D inverse = 1.0 / vsqrt(length2 == 0.0 ? splat(1.0) : length2);
      for (int i = 0; i < 3; ++i) direction[i] *= inverse;
      sh_basis(P.primitives.sh_count, direction[0], direction[1], direction[2], basis);
    }

    for (int l = 0; l < lanes; ++l) {
      if (!visible[l]) continue;
      const int64_t row = first + l;
      Record<Real>& record = P.records[row];
      for (int s = 0; s < 8; ++s) {
        record.a[s] = Real(a[s][l]), record.b[s] = Real(b[s][l]), record.c[s] = Real(c[s][l]);
        for (int k = 0; k < 3; ++k) record.face[k][s] = Real(face[k][s][l]);
      }
      record.w0 = Real(ref.w0[l]);
      record.density = std::clamp(P.primitives.density[row], Real(0), Real(kLargestDensity));
      record.ref_x = int(ref.x[l]), record.ref_y = int(ref.y[l]);
      record.flags = (front[0][l] ? 1u : 0u) | (front[1][l] ? 2u : 0u) | (front[2][l] ? 4u : 0u) | (front[3][l] ? 8u : 0u) |
                     (general[l] ? kGeneral : 0u);
      print[l].ref_x = record.ref_x, print[l].ref_y = record.ref_y;
      if (!general[l]) {
        for (int e = 0; e < 6; ++e)
          print[l].a[e] = float(line_a[e][l]), print[l].b[e] = float(line_b[e][l]), print[l].c[e] = float(line_c[e][l]);
      } else if (ref.crosses_near[l]) {
        for (int e = 0; e < 6; ++e) print[l].a[e] = 1, print[l].b[e] = print[l].c[e] = 0;
      } else {
        bool is_front[8];
        double signs[8][3];
        for (int s = 0; s < 8; ++s) {
          is_front[s] = s < 4 && front[s][l];
          for (int k = 0; k < 3; ++k) signs[s][k] = kSign[s & 3][k] * side[s & 3][l] * (s < 4 ? 1 : -1);
        }
        silhouette_lines(record, is_front, signs, print[l]);
      }
      for (int e = 0; e < 6; ++e) {
        const float lb = print[l].b[e], lc = print[l].c[e];
        print[l].a[e] += float(kBlock - 1) * (std::max(lb, 0.0f) + std::max(lc, 0.0f)) +
                         float(kPixelSlack) * (std::fabs(lb) + std::fabs(lc)) + 1e-6f * std::fabs(print[l].a[e]);
      }
      const int count = P.primitives.sh_count;
      const Real* sh = P.primitives.sh + row * count * 3;
      double rgb[3] = {0.5, 0.5, 0.5};
      for (int i = 0; i < count; ++i)
        for (int k = 0; k < 3; ++k) rgb[k] += basis[i][l] * double(sh[3 * i + k]);
      // A colour that is not finite is handed on as it is, for the caller to find.
      for (int k = 0; k < 3; ++k) record.rgb[k] = P.color[3 * row + k] = Real(std::isfinite(rgb[k]) ? std::max(rgb[k], 0.0) : rgb[k]);
      if (P.normals) {
        for (int j = 0; j < 4; ++j) {
          double n[3], length2 = 0;
          for (int i = 0; i < 3; ++i) {
            n[i] = side[j][l] * (kSign[j][0] * f.n[0][i][l] + kSign[j][1] * f.n[1][i][l] + kSign[j][2] * f.n[2][i][l]);
            length2 += n[i] * n[i];
          }
          for (int i = 0; i < 3; ++i) P.normals[row][j][i] = Real(n[i] / std::sqrt(length2));
        }
      }
    }
  }
}

template <class Real>
inline void zero_row(const PrimitiveGradients<Real>& out, int64_t row, int sh_count) {
  for (int k = 0; k < 3; ++k) out.center[3 * row + k] = out.extent[3 * row + k] = 0;
  for (int k = 0; k < 4; ++k) out.rotation[4 * row + k] = 0;
  for (int k = 0; k < 3; ++k) out.screen[3 * row + k] = 0;
  out.density[row] = 0;
  std::memset(out.sh + row * sh_count * 3, 0, sizeof(Real) * sh_count * 3);
}

template <class Real>
void chain(const ChainParams<Real>& P, int64_t begin, int64_t end) {
  const View& view = P.view;
  const double* w = view.world_to_camera;
  double eye[3];
  for (int i = 0; i < 3; ++i) eye[i] = -(w[i] * w[3] + w[4 + i] * w[7] + w[8 + i] * w[11]);
  const int sh_count = P.primitives.sh_count;
  const bool geometry = P.sums_per_slot == kGeometrySums;

  for (int64_t first = begin; first < end; first += kLanes) {
    const int lanes = int(std::min<int64_t>(kLanes, end - first));
    int64_t rows[kLanes];
    for (int l = 0; l < kLanes; ++l) rows[l] = first + std::min(l, lanes - 1);
    for (int64_t next = first + 2 * kLanes; next < std::min(end, first + 3 * kLanes); ++next)  // slots lie in the order of depth
      if (P.slot_count[next]) __builtin_prefetch(P.sums + int64_t(P.first_slot[next]) * P.sums_per_slot);
    bool any = false;
    double sums[kLanes][kGeometrySums] = {};
    for (int l = 0; l < lanes; ++l) {
      const uint32_t count = P.slot_count[first + l];
      const Real* slot = P.sums + int64_t(P.first_slot[first + l]) * P.sums_per_slot;
      for (uint32_t s = 0; s < count; ++s, slot += P.sums_per_slot)
        for (int t = 0; t < P.sums_per_slot; ++t) sums[l][t] += double(slot[t]);
      any |= count != 0;
    }
    for (int l = 0; l < lanes; ++l)
      if (P.slot_count[first + l] == 0) zero_row(P.out, first + l, sh_count);
    if (!any) continue;
    auto sum = [&](int t) {
      D r;
      for (int l = 0; l < kLanes; ++l) r[l] = sums[std::min(l, lanes - 1)][t];
      return r;
    };

    Frame8 f;
    set_up(view, P.primitives, rows, f);
    const Reference ref = reference_of(view, f);
    D center_grad[3] = {}, n_grad[3][3], axis_grad[3][3], extent_grad[3];
    for (int k = 0; k < 3; ++k) {
      // p_k = n_k . v - m_k w0 and h_s = 1 + s . m with m_k = n_k . center: gradient to n_k and, through m, to the centre.
      const D g = sum(Sum::g + k), gw = sum(Sum::gw + k);
      n_grad[k][0] = g * ref.base[0] + sum(Sum::gx + k) * (1.0 / view.fx) - f.center[0] * gw;
      n_grad[k][1] = g * ref.base[1] + sum(Sum::gy + k) * (1.0 / view.fy) - f.center[1] * gw;
      n_grad[k][2] = g * ref.base[2] - f.center[2] * gw;
      const D m_grad = -(ref.w0 * g + gw);
      for (int i = 0; i < 3; ++i) center_grad[i] += m_grad * f.n[k][i];
    }
    if (geometry) {
      D sigma[4];
      pair_sums(f.m, sigma);
      for (int j = 0; j < 4; ++j) {
        const D side = sigma[j] > 0.0 ? splat(-1.0) : splat(1.0);
        D n[3], q[3], length2{}, along{};
        for (int i = 0; i < 3; ++i) {
          n[i] = side * (kSign[j][0] * f.n[0][i] + kSign[j][1] * f.n[1][i] + kSign[j][2] * f.n[2][i]);
          q[i] = sum(Sum::normal + 3 * j + i);
          length2 += n[i] * n[i];
          along += n[i] * q[i];
        }
        const D inverse = 1.0 / vsqrt(length2);
        for (int i = 0; i < 3; ++i) {
          const D back = (q[i] - n[i] * along / length2) * inverse * side;
          for (int k = 0; k < 3; ++k) n_grad[k][i] += kSign[j][k] * back;
        }
      }
    }
    for (int k = 0; k < 3; ++k) {
      D along{};
      for (int i = 0; i < 3; ++i) {
        along += f.n[k][i] * n_grad[k][i];
        axis_grad[k][i] = n_grad[k][i] / f.extent[k] * f.flip[k];
      }
      extent_grad[k] = -along / f.extent[k];
    }
    // axis_k = W R e_k, so the gradient to R is W^T [axis_grad]; then to the unit quaternion and through its normalisation.
    D G[3][3];
    for (int i = 0; i < 3; ++i)
      for (int k = 0; k < 3; ++k) G[i][k] = w[i] * axis_grad[k][0] + w[4 + i] * axis_grad[k][1] + w[8 + i] * axis_grad[k][2];
    const D &a = f.q[0], &x = f.q[1], &y = f.q[2], &z = f.q[3];
    D q_grad[4] = {
        2.0 * (x * (G[2][1] - G[1][2]) + y * (G[0][2] - G[2][0]) + z * (G[1][0] - G[0][1])),
        2.0 * (-2.0 * x * (G[1][1] + G[2][2]) + y * (G[0][1] + G[1][0]) + z * (G[0][2] + G[2][0]) + a * (G[2][1] - G[1][2])),
        2.0 * (x * (G[0][1] + G[1][0]) - 2.0 * y * (G[0][0] + G[2][2]) + z * (G[1][2] + G[2][1]) + a * (G[0][2] - G[2][0])),
        2.0 * (x * (G[0][2] + G[2][0]) + y * (G[1][2] + G[2][1]) - 2.0 * z * (G[0][0] + G[1][1]) + a * (G[1][0] - G[0][1]))};
    const D radial = q_grad[0] * a + q_grad[1] * x + q_grad[2] * y + q_grad[3] * z;
    for (int k = 0; k < 4; ++k) q_grad[k] = f.no_rotation ? splat(0.0) : (q_grad[k] - radial * f.q[k]) / f.q_length;

    // Colour: rgb = max(0, 0.5 + sum_i basis_i(direction) sh_i), direction = (center - eye) / |center - eye|.
    D direction[3], length2{}, basis[kMaxShCoefficients], slope[kMaxShCoefficients][3];
    for (int i = 0; i < 3; ++i) {
      direction[i] = gather(P.primitives.center + i, 3, rows) - eye[i];
      length2 += direction[i] * direction[i];
    }
    const D inverse = 1.0 / vsqrt(length2 == 0.0 ? splat(1.0) : length2);
    for (int i = 0; i < 3; ++i) direction[i] *= inverse;
    sh_basis(sh_count, direction[0], direction[1], direction[2], basis);
    sh_basis_grad(sh_count, direction[0], direction[1], direction[2], slope);

    for (int l = 0; l < lanes; ++l) {
      const int64_t row = first + l;
      if (P.slot_count[row] == 0) continue;
      double world[3];
      for (int i = 0; i < 3; ++i)
        world[i] = w[i] * center_grad[0][l] + w[4 + i] * center_grad[1][l] + w[8 + i] * center_grad[2][l];
      const Real* sh = P.primitives.sh + row * sh_count * 3;
      Real* sh_out = P.out.sh + row * sh_count * 3;
      double rgb_grad[3], direction_grad[3] = {};
      for (int k = 0; k < 3; ++k) rgb_grad[k] = P.color[3 * row + k] > 0 ? sums[l][Sum::rgb + k] : 0.0;
      for (int i = 0; i < sh_count; ++i) {
        double along = 0;
        for (int k = 0; k < 3; ++k) {
          sh_out[3 * i + k] = Real(basis[i][l] * rgb_grad[k]);
          along += double(sh[3 * i + k]) * rgb_grad[k];
        }
        for (int t = 0; t < 3; ++t) direction_grad[t] += slope[i][t][l] * along;
      }
      double radial_part = 0;
      for (int t = 0; t < 3; ++t) radial_part += direction_grad[t] * direction[t][l];
      const double z = ref.crosses_near[l] ? 0.0 : f.center[2][l];
      P.out.screen[3 * row] = Real(center_grad[0][l] * z / view.fx);
      P.out.screen[3 * row + 1] = Real(center_grad[1][l] * z / view.fy);
      double pull = 0;
      const Real* slot = P.sums + int64_t(P.first_slot[row]) * P.sums_per_slot;
      for (uint32_t s = 0; s < P.slot_count[row]; ++s, slot += P.sums_per_slot) {
        double x = 0, y = 0;
        for (int k = 0; k < 3; ++k) {
          const double m_grad = -(ref.w0[l] * double(slot[Sum::g + k]) + double(slot[Sum::gw + k]));
          x += m_grad * f.n[k][0][l], y += m_grad * f.n[k][1][l];
        }
        pull += z * std::sqrt((x / view.fx) * (x / view.fx) + (y / view.fy) * (y / view.fy));
      }
      P.out.screen[3 * row + 2] = Real(pull);
      for (int i = 0; i < 3; ++i) {
        P.out.center[3 * row + i] = Real(world[i] + (direction_grad[i] - radial_part * direction[i][l]) * inverse[l]);
        P.out.extent[3 * row + i] = Real(extent_grad[i][l]);
      }
      for (int k = 0; k < 4; ++k) P.out.rotation[4 * row + k] = Real(q_grad[k][l]);
      const double density = double(P.primitives.density[row]);
      P.out.density[row] = density < 0 || density > kLargestDensity ? Real(0) : Real(sums[l][Sum::density]);
    }
  }
}

}  // namespace linprim::LINPRIM_ISA
