// Octahedra: how a tile kernel intersects them (entry and exit of the rays of 16, 8, 4 or 1 pixels), how an octahedron
// is projected to a record for that, and the backward passes of both.
#pragma once

#include "primitives/polyhedron.h"
#include "primitives/polyhedron_project.h"

namespace linprim::LINPRIM_ISA {

// A projected octahedron as the tile kernels read it. Slots 0-3 hold, of each pair of opposite faces, the one turned to
// the camera; slots 4-7 hold their opposites, which are always back faces.
template <class Real>
struct alignas(64) OctahedronRecord {
  Real a[8], b[8], c[8];  // planes of the faces, see polyhedron.h
  Real w0, density, rgb[3];
  Real ref_x, ref_y;  // integers
  uint32_t flags;   // bits 0-3: slot 0-3 is a front face; bit 4: take the general path (not all are, or the near plane
                    // is crossed)
  Real face[3][8];  // s_k / h_s: derivative of the face's w with respect to the local form p_k
};
constexpr uint32_t kGeneral = 16;

template <class RealType, int W, RayModel kRays>
struct Octahedron : Polyhedron<RealType, W, kRays> {
  using Real = RealType;
  using Record = OctahedronRecord<Real>;
  using Base = Polyhedron<Real, W, kRays>;
  using V = typename Base::V;
  using M = typename Base::M;
  using I = typename Base::I;
  using Intersection = typename Base::Intersection;

  // Computes the planes where the rays enter and leave; x and y are in pixels relative to the record's reference.
  // kTrack: also which faces.
  template <bool kTrack>
  static M intersect(const Record& r, const View& view, V x, V y, V, Intersection& m) {
    auto value = [&](int f) { return fma(V::set(r.b[f]), x, fma(V::set(r.c[f]), y, V::set(r.a[f]))); };
    auto enter = [&](V w, int f) {
      if constexpr (kTrack) m.in_face = select(w < m.in, I::set(f), m.in_face);
      m.in = min(w, m.in);
    };
    auto leave = [&](V w, int f) {
      if constexpr (kTrack) m.out_face = select(m.out < w, I::set(f), m.out_face);
      m.out = max(w, m.out);
    };
    // With affine rays, one face of each pair is turned to the camera, and nothing is cut at the near plane.
    if (kRays == RayModel::kAffine || !(r.flags & kGeneral)) [[likely]] {
      if constexpr (kTrack) {
        m.in = value(0), m.out = value(4);
        m.in_face = I::set(0), m.out_face = I::set(4);
        for (int f = 1; f < 4; ++f) enter(value(f), f), leave(value(4 + f), 4 + f);
      } else {
        m.in = min(min(value(0), value(1)), min(value(2), value(3)));
        m.out = max(max(value(4), value(5)), max(value(6), value(7)));
      }
    } else {
      m.in = V::set(Real(1 / view.near) - r.w0), m.out = V::set(Real(kFarInverse) - r.w0);
      if constexpr (kTrack) m.in_face = I::set(kNearPlane), m.out_face = I::set(kNearPlane);
      for (int f = 0; f < 8; ++f) {
        if (f < 4 && (r.flags >> f & 1)) {
          enter(value(f), f);
        } else {
          leave(value(f), f);
        }
      }
    }
    return m.out < m.in;
  }

  // Accumulates the gradients of the entry and exit planes (0 in lanes without a hit) in the sums of the three local
  // forms p_k: with g the gradient to p_k, the sums of g, g x, g y and g w at 0, 3, 6 and 9. px and py are positions
  // relative to the pair's origin.
  static void add_planes(const Record& r, const Intersection& m, M hit, V g_in, V g_out, V px, V py, V* sums) {
    // A lane without a hit may hold an infinity, and 0 times infinity is NaN.
    const V zero = V::set(0), g_in_w = g_in * select(hit, m.in, zero), g_out_w = g_out * select(hit, m.out, zero);
    for (int k = 0; k < 3; ++k) {
      const V s_in = lookup8(r.face[k], m.in_face), s_out = lookup8(r.face[k], m.out_face);
      const V g = fma(g_in, s_in, g_out * s_out);
      sums[k] = sums[k] + g;
      sums[3 + k] = fma(g, px, sums[3 + k]);
      sums[6 + k] = fma(g, py, sums[6 + k]);
      sums[9 + k] = fma(g_in_w, s_in, fma(g_out_w, s_out, sums[9 + k]));
    }
  }
  // Converts a slot's sums from their origin, a pixel of the tile, to the reference pixel.
  static void recenter(const Record& r, Real origin_x, Real origin_y, Real* slot) {
    const Real dx = origin_x - r.ref_x, dy = origin_y - r.ref_y;
    for (int k = 0; k < 3; ++k) slot[3 + k] += dx * slot[k], slot[6 + k] += dy * slot[k];
  }
};

// The local forms n_k = axis_k / extent_k. Axes are mirrored so that m_k = n_k . c >= 0 (affine: n_k . j), which leaves
// the octahedron unchanged; `flip` undoes it.
template <RayModel kRays>
struct OctahedronFrame {
  Pose pose;
  D extent[3], flip[3];
  D n[3][3];
  D arm[6][3];  // vertices from the centre: +-0, +-1, +-2
  D smallest = splat(1e300);

  template <class Real>
  OctahedronFrame(const View& view, const Primitives<Real>& p, const int64_t* rows) {
    set_pose(view, p, rows, pose);
    D held[3];
    B free[2];
    const D* towards = pose.center;
    if constexpr (kRays == RayModel::kAffine) RayFrame<kRays>::hold(view, pose.center, held, free), towards = held;
    for (int k = 0; k < 3; ++k) {
      const D raw = gather(p.extent + k, 3, rows);
      smallest = vmin(smallest, raw);
      extent[k] = clamp(raw, kSmallestExtent, kLargestExtent);
      flip[k] = dot(pose.axis[k], towards) < 0.0 ? splat(-1.0) : splat(1.0);
      const D inverse = flip[k] / extent[k];
      for (int i = 0; i < 3; ++i) {
        n[k][i] = pose.axis[k][i] * inverse;
        arm[2 * k][i] = pose.axis[k][i] * extent[k], arm[2 * k + 1][i] = -arm[2 * k][i];
      }
    }
  }
  D reach_z() const { return vmax(vmax(vabs(arm[0][2]), vabs(arm[2][2])), vabs(arm[4][2])); }
};

// Signs of the four pairs of opposite faces: pair j is +-(kSign[j][0], kSign[j][1], kSign[j][2]).
constexpr double kSign[4][3] = {{1, 1, 1}, {1, 1, -1}, {1, -1, 1}, {-1, 1, 1}};

inline void pair_sums(const D v[3], D out[4]) {
  out[0] = v[0] + v[1] + v[2];
  out[1] = v[0] + v[1] - v[2];
  out[2] = v[0] - v[1] + v[2];
  out[3] = v[1] - v[0] + v[2];
}

// Silhouette half-planes of one lane for the general path: from every edge between a front and a back face.
inline void silhouette_lines(const D* a, const D* b, const D* c, int l, const bool front[8], const double signs[8][3],
                             D* line_a, D* line_b, D* line_c) {
  int count = 0;
  for (int i = 0; i < 8; ++i)
    for (int j = 0; j < 8; ++j) {
      if (!front[i] || front[j] || count == 6) continue;
      int differ = 0;
      for (int k = 0; k < 3; ++k) differ += signs[i][k] != signs[j][k];
      if (differ != 1) continue;
      line_a[count][l] = a[i][l] - a[j][l], line_b[count][l] = b[i][l] - b[j][l], line_c[count][l] = c[i][l] - c[j][l];
      ++count;
    }
  for (; count < 6; ++count) line_a[count][l] = 1, line_b[count][l] = line_c[count][l] = 0;
}

template <class Real, RayModel kRays>
void project_octahedra(const ProjectParams<Real>& P, int64_t begin, int64_t end) {
  constexpr bool kExact = kRays == RayModel::kExact;
  using Record = OctahedronRecord<Real>;
  constexpr int kRow = sizeof(Record) / sizeof(Real);
  const View& view = P.view;
  const Eye eye(view);
  const double longest = longest_ray(view);
  Record* records = static_cast<Record*>(P.records);

  for (int64_t first = begin; first < end; first += kLanes) {
    const int lanes = int(std::min<int64_t>(kLanes, end - first));
    int64_t rows[kLanes];
    for (int l = 0; l < kLanes; ++l) rows[l] = first + std::min(l, lanes - 1);
    const OctahedronFrame<kRays> f(view, P.primitives, rows);
    const D reach = f.reach_z(), *center = f.pose.center;
    const RayFrame<kRays> rays(view, center, reach);

    Box box = box_of(rays, f.arm, 6);
    D density = clamp(gather(P.primitives.density, 1, rows), 0.0, kLargestDensity);
    const ScreenFilter<kRays> filter(rays, box);
    if (view.screen_filter > 0) {
      filter.grow(rays, box);
      density *= filter.scale_x * filter.scale_y;
    }
    if constexpr (kExact) clip_boxes<true>(view, center, f.arm, 6, rays.crosses_near, lanes, box);
    B visible = (B)(f.smallest > 0.0) & (kExact ? (B)(center[2] + reach > view.near) : (B)(center[2] > view.near));
    Footprint* print = P.footprints + first;
    set_boxes(view, box.low_x, box.high_x, box.low_y, box.high_y, lanes, visible, print);
    D nearest = center[2] - reach;
    if constexpr (!kExact)
      nearest = rays.length - vmax(vmax(vabs(dot(rays.held, f.arm[0])), vabs(dot(rays.held, f.arm[2]))),
                                   vabs(dot(rays.held, f.arm[4]))) *
                                  rays.inverse_held;
    const D key = order_key(rays, nearest, longest);
    for (int l = 0; l < lanes; ++l) {
      P.key[first + l] = Real(key[l]);
      Real* color = P.color + 3 * (first + l);
      color[0] = color[1] = color[2] = 0;
    }
    if (!any(visible)) continue;

    // Local forms at the reference pixel and their steps per pixel, then the face planes.
    D p[3], px[3], py[3], m[3], q[4], qx[4], qy[4], sigma[4];
    for (int k = 0; k < 3; ++k) {
      rays.form(f.n[k], p[k], px[k], py[k], m[k]);
      if (view.screen_filter > 0) filter.apply(p[k], px[k], py[k]);
    }
    pair_sums(p, q), pair_sums(px, qx), pair_sums(py, qy), pair_sums(m, sigma);
    D plane[24], face[24], side[4];
    D *a = plane, *b = plane + 8, *c = plane + 16;
    B front[4];
    for (int j = 0; j < 4; ++j) {
      side[j] = sigma[j] > 0.0 ? splat(-1.0) : splat(1.0);
      const D size = vabs(sigma[j]);
      D near_side, far_side;
      if constexpr (kExact) {
        const D h = off_edge(1.0 - size, 1.0 + size);
        front[j] = (B)(h < 0.0);
        near_side = 1.0 / h, far_side = 1.0 / (1.0 + size);
      } else {
        far_side = 1.0 / off_edge(size, m[0] + m[1] + m[2]), near_side = -far_side;
        front[j] = ~B{};
      }
      a[j] = (side[j] * q[j] - rays.kappa) * near_side, a[4 + j] = (-side[j] * q[j] - rays.kappa) * far_side;
      b[j] = side[j] * qx[j] * near_side, b[4 + j] = -side[j] * qx[j] * far_side;
      c[j] = side[j] * qy[j] * near_side, c[4 + j] = -side[j] * qy[j] * far_side;
      for (int k = 0; k < 3; ++k)
        face[8 * k + j] = kSign[j][k] * side[j] * near_side, face[8 * k + 4 + j] = -kSign[j][k] * side[j] * far_side;
    }
    const B general = ~(front[0] & front[1] & front[2] & front[3]) | rays.crosses_near;

    // Silhouette: with m >= 0 at most one of sigma[1..3] is negative. If none is, the silhouette is a hexagon and its
    // edges lie between the face pairs {1,2}, {1,3}, {2,3}; if sigma[k] is, it is a quadrilateral between {0,k} and the
    // other two.
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
    if (kExact && any(general & visible))
      for (int l = 0; l < lanes; ++l) {
        if (!general[l]) continue;
        bool is_front[8];
        double signs[8][3];
        for (int s = 0; s < 8; ++s) {
          is_front[s] = s < 4 && front[s][l];
          for (int k = 0; k < 3; ++k) signs[s][k] = kSign[s & 3][k] * side[s & 3][l] * (s < 4 ? 1 : -1);
        }
        silhouette_lines(a, b, c, l, is_front, signs, line_a, line_b, line_c);
      }
    set_lines(line_a, line_b, line_c, 6, lanes, print);

    Record* record = records + first;
    to_rows(&record[0].a[0], kRow, plane, 24, lanes);
    to_rows(&record[0].face[0][0], kRow, face, 24, lanes);
    for (int l = 0; l < lanes; ++l) {
      record[l].w0 = Real(rays.w0[l]), record[l].density = Real(density[l]);
      record[l].ref_x = Real(rays.ref_x[l]), record[l].ref_y = Real(rays.ref_y[l]);
      print[l].ref_x = int(rays.ref_x[l]), print[l].ref_y = int(rays.ref_y[l]);
      record[l].flags = (front[0][l] ? 1u : 0u) | (front[1][l] ? 2u : 0u) | (front[2][l] ? 4u : 0u) |
                        (front[3][l] ? 8u : 0u) | (general[l] ? kGeneral : 0u);
    }
    evaluate_color(eye, f.pose, P.primitives, first, lanes, visible, P.color, &record[0].rgb[0], kRow);
    if (P.normals)
      for (int j = 0; j < 4; ++j) {
        D normal[3];
        for (int i = 0; i < 3; ++i)
          normal[i] = side[j] * (kSign[j][0] * f.n[0][i] + kSign[j][1] * f.n[1][i] + kSign[j][2] * f.n[2][i]);
        const D inverse = 1.0 / vsqrt(dot(normal, normal));
        for (int i = 0; i < 3; ++i)
          for (int l = 0; l < lanes; ++l) P.normals[first + l][j][i] = Real(normal[i][l] * inverse[l]);
      }
  }
}

template <class Real, RayModel kRays>
void project_octahedra_backward(const ProjectBackwardParams<Real>& P, int64_t begin, int64_t end) {
  const View& view = P.view;
  const Eye eye(view);
  const bool geometry = P.sums_per_slot == kGeometrySums;

  for (int64_t first = begin; first < end; first += kLanes) {
    const int lanes = int(std::min<int64_t>(kLanes, end - first));
    int64_t rows[kLanes];
    for (int l = 0; l < kLanes; ++l) rows[l] = first + std::min(l, lanes - 1);
    double sums[kLanes][kGeometrySums];
    if (!gather_sums(P, first, lanes, sums)) continue;
    auto sum = [&](int t) {
      D r;
      for (int l = 0; l < kLanes; ++l) r[l] = sums[std::min(l, lanes - 1)][t];
      return r;
    };

    const OctahedronFrame<kRays> f(view, P.primitives, rows);
    const RayFrame<kRays> rays(view, f.pose.center, f.reach_z());
    const bool filtered = view.screen_filter > 0;
    const Box box = filtered ? box_of(rays, f.arm, 6) : Box{};
    ScreenFilter<kRays> filter(rays, box);
    RowGradients out{};
    D n_grad[3][3] = {}, m[3];
    for (int k = 0; k < 3; ++k) {
      // w_s = (sum_k s_k p_k - kappa) / h_s with h_s = (1 +) sum_k s_k m_k, and the sums hold gradients over h_s.
      const D g = sum(k);
      D gx = sum(3 + k), gy = sum(6 + k), p, px, py;
      rays.form(f.n[k], p, px, py, m[k]);
      if (filtered) filter.apply_grad(px, py, g, gx, gy);
      rays.form_grad(f.n[k], g, gx, gy, -sum(9 + k), n_grad[k], out.center);
    }
    if (geometry) {
      D sigma[4];
      pair_sums(m, sigma);
      for (int j = 0; j < 4; ++j) {
        const D side = sigma[j] > 0.0 ? splat(-1.0) : splat(1.0);
        D n[3], q[3];
        for (int i = 0; i < 3; ++i) {
          n[i] = side * (kSign[j][0] * f.n[0][i] + kSign[j][1] * f.n[1][i] + kSign[j][2] * f.n[2][i]);
          q[i] = sum(Sum::normal + 3 * j + i);
        }
        const D length2 = dot(n, n), along = dot(n, q) / length2, inverse = 1.0 / vsqrt(length2);
        for (int i = 0; i < 3; ++i) {
          const D back = (q[i] - n[i] * along) * inverse * side;
          for (int k = 0; k < 3; ++k) n_grad[k][i] += kSign[j][k] * back;
        }
      }
      if constexpr (kRays == RayModel::kAffine)
        for (int i = 0; i < 3; ++i) out.center[i] += sum(Sum::distance) * f.pose.center[i] * rays.inverse_length;
    }
    for (int k = 0; k < 3; ++k) {
      const D inverse = 1.0 / f.extent[k];
      out.extent[k] = -dot(f.n[k], n_grad[k]) * inverse;
      for (int i = 0; i < 3; ++i) out.axis[k][i] = n_grad[k][i] * inverse * f.flip[k];
    }
    out.density = sum(Sum::density);
    if (filtered) {
      D arm_grad[6][3] = {};
      const D density = clamp(gather(P.primitives.density, 1, rows), 0.0, kLargestDensity);
      filter.finish(rays, box, f.arm, 6, density, out.density, arm_grad, out.center);
      out.density *= filter.scale_x * filter.scale_y;
      for (int k = 0; k < 3; ++k)
        for (int i = 0; i < 3; ++i) {
          const D g = arm_grad[2 * k][i] - arm_grad[2 * k + 1][i];
          out.axis[k][i] += g * f.extent[k], out.extent[k] += g * f.pose.axis[k][i];
        }
    }
    // Screen-space gradients, total and per tile: as if the centre moved at its depth, or at the middle of the depths
    // beyond the near plane.
    const D z = rays.crosses_near ? (view.near + f.pose.center[2] + f.reach_z()) * 0.5 : f.pose.center[2];
    out.screen_x = out.center[0] * z * (1.0 / view.fx), out.screen_y = out.center[1] * z * (1.0 / view.fy);
    double pull[kLanes] = {};
    for (int l = 0; l < lanes; ++l) {
      const Real* slot = P.sums + int64_t(P.first_slot[first + l]) * P.sums_per_slot;
      double nx[3], ny[3];
      for (int k = 0; k < 3; ++k) nx[k] = f.n[k][0][l] * z[l] / view.fx, ny[k] = f.n[k][1][l] * z[l] / view.fy;
      const double w0 = kRays == RayModel::kExact ? rays.w0[l] : 1.0;
      for (uint32_t s = 0; s < P.slot_count[first + l]; ++s, slot += P.sums_per_slot) {
        double x = 0, y = 0;
        for (int k = 0; k < 3; ++k) {
          const double g = -(w0 * double(slot[k]) + (kRays == RayModel::kExact ? double(slot[9 + k]) : 0.0));
          x += g * nx[k], y += g * ny[k];
        }
        pull[l] += std::sqrt(x * x + y * y);
      }
    }
    write_rows(P, eye, f.pose, out, first, lanes, sums, pull);
  }
}

}  // namespace linprim::LINPRIM_ISA
