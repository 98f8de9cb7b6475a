// Tetrahedra: how a tile kernel intersects them (entry and exit of the rays of 16, 8, 4 or 1 pixels), how a tetrahedron
// is projected to a record for that, and the backward passes of both.
//
// Vertices are c + d_j e_j with e_j the four rotated directions of a regular tetrahedron. As sum e_j = 0 and e_i . e_j
// = -1/3, the face opposite to vertex j is n_j . (x - c) = 1 with n_j = 3/4 sum_(i != j) u_i (e_i - e_j), u = 1/d,
// which does not depend on d_j.
#pragma once

#include "primitives/polyhedron.h"
#include "primitives/polyhedron_project.h"

namespace linprim::LINPRIM_ISA {

// A projected tetrahedron as the tile kernels read it.
template <class Real>
struct alignas(16) TetrahedronRecord {
  Real a[4], b[4], c[4];  // planes of the faces, see polyhedron.h
  Real w0, density, rgb[3];
  Real ref_x, ref_y;
  uint32_t flags;  // bits 0-3: face 0-3 is a front face
};

template <class RealType, int W, RayModel kRays>
struct Tetrahedron : Polyhedron<RealType, W, kRays> {
  using Real = RealType;
  using Record = TetrahedronRecord<Real>;
  using Base = Polyhedron<Real, W, kRays>;
  using V = typename Base::V;
  using M = typename Base::M;
  using I = typename Base::I;
  using Intersection = typename Base::Intersection;

  // Computes the planes where the rays enter and leave; x and y are in pixels relative to the record's reference.
  // kTrack: also which faces.
  template <bool kTrack>
  static M intersect(const Record& r, const View& view, V x, V y, V, Intersection& m) {
    constexpr bool kExact = kRays == RayModel::kExact;
    m.in = V::set(kExact ? Real(1 / view.near) - r.w0 : Real(kBeyond));
    m.out = V::set(kExact ? Real(kFarInverse) - r.w0 : Real(-kBeyond));
    if constexpr (kTrack) m.in_face = I::set(kNearPlane), m.out_face = I::set(kNearPlane);
    for (int f = 0; f < 4; ++f) {
      const V w = fma(V::set(r.b[f]), x, fma(V::set(r.c[f]), y, V::set(r.a[f])));
      const M front = M::all(r.flags >> f & 1), back = M::all(!(r.flags >> f & 1));
      const M enters = front & (w < m.in), leaves = back & (m.out < w);
      if constexpr (kTrack)
        m.in_face = select(enters, I::set(f), m.in_face), m.out_face = select(leaves, I::set(f), m.out_face);
      m.in = select(enters, w, m.in), m.out = select(leaves, w, m.out);
    }
    return m.out < m.in;
  }

  // Accumulates the gradients of the entry and exit planes (0 in lanes without a hit): with g the gradient to face f's
  // plane, the sums of g, g x and g y at f, 4 + f and 8 + f. px and py are positions relative to the pair's origin.
  static void add_planes(const Record&, const Intersection& m, M, V g_in, V g_out, V px, V py, V* sums) {
    const V zero = V::set(0);
    for (int f = 0; f < 4; ++f) {
      const V g = select(equal(m.in_face, f), g_in, select(equal(m.out_face, f), g_out, zero));
      sums[f] = sums[f] + g;
      sums[4 + f] = fma(g, px, sums[4 + f]);
      sums[8 + f] = fma(g, py, sums[8 + f]);
    }
  }
  static void recenter(const Record& r, Real origin_x, Real origin_y, Real* slot) {
    const Real dx = origin_x - r.ref_x, dy = origin_y - r.ref_y;
    for (int f = 0; f < 4; ++f) slot[4 + f] += dx * slot[f], slot[8 + f] += dy * slot[f];
  }
};

constexpr double kCorner = 0.57735026918962576;  // 1 / sqrt(3)
constexpr double kDirection[4][3] = {{kCorner, kCorner, kCorner},
                                     {kCorner, -kCorner, -kCorner},
                                     {-kCorner, kCorner, -kCorner},
                                     {-kCorner, -kCorner, kCorner}};

struct TetrahedronFrame {
  Pose pose;
  D extent[4], u[4];
  D e[4][3];    // directions of the vertices, camera space
  D n[4][3];    // faces
  D arm[4][3];  // vertices from the centre
  D low_z, high_z, smallest;

  template <class Real>
  TetrahedronFrame(const View& view, const Primitives<Real>& p, const int64_t* rows) {
    set_pose(view, p, rows, pose);
    low_z = splat(1e300), high_z = splat(-1e300), smallest = splat(1e300);
    for (int j = 0; j < 4; ++j) {
      const D raw = gather(p.extent + j, 4, rows);
      smallest = vmin(smallest, raw);
      extent[j] = clamp(raw, kSmallestExtent, kLargestExtent);
      u[j] = 1.0 / extent[j];
      for (int i = 0; i < 3; ++i) {
        e[j][i] = kDirection[j][0] * pose.axis[0][i] + kDirection[j][1] * pose.axis[1][i] +
                  kDirection[j][2] * pose.axis[2][i];
        arm[j][i] = e[j][i] * extent[j];
      }
      low_z = vmin(low_z, arm[j][2]), high_z = vmax(high_z, arm[j][2]);
    }
    for (int j = 0; j < 4; ++j)
      for (int t = 0; t < 3; ++t) {
        n[j][t] = splat(0.0);
        for (int i = 0; i < 4; ++i)
          if (i != j) n[j][t] += 0.75 * u[i] * (e[i][t] - e[j][t]);
      }
  }
};

// Planes a + b x + c y of the faces over the pixels, and the divisor h of each.
template <RayModel kRays>
struct TetrahedronPlanes {
  D a[4], b[4], c[4], h[4], px[4], py[4];  // px, py: of the unfiltered numerators
  TetrahedronPlanes(const TetrahedronFrame& f, const RayFrame<kRays>& rays, const ScreenFilter<kRays>& filter) {
    for (int j = 0; j < 4; ++j) {
      D p, m;
      rays.form(f.n[j], p, px[j], py[j], m);
      D x = px[j], y = py[j];
      if (rays.view.screen_filter > 0) filter.apply(p, x, y);
      if constexpr (kRays == RayModel::kExact) {
        h[j] = off_edge(1.0 + m, 1.0 + vabs(m));
      } else {
        h[j] = off_edge(m, vsqrt(dot(f.n[j], f.n[j])));
      }
      const D inverse = 1.0 / h[j];
      a[j] = (p - rays.kappa) * inverse, b[j] = x * inverse, c[j] = y * inverse;
    }
  }
};

template <class Real, RayModel kRays>
void project_tetrahedra(const ProjectParams<Real>& P, int64_t begin, int64_t end) {
  constexpr bool kExact = kRays == RayModel::kExact;
  using Record = TetrahedronRecord<Real>;
  constexpr int kRow = sizeof(Record) / sizeof(Real);
  const View& view = P.view;
  const Eye eye(view);
  const double longest = longest_ray(view);
  Record* records = static_cast<Record*>(P.records);

  for (int64_t first = begin; first < end; first += kLanes) {
    const int lanes = int(std::min<int64_t>(kLanes, end - first));
    int64_t rows[kLanes];
    for (int l = 0; l < kLanes; ++l) rows[l] = first + std::min(l, lanes - 1);
    const TetrahedronFrame f(view, P.primitives, rows);
    const D* center = f.pose.center;
    const RayFrame<kRays> rays(view, center, -f.low_z);

    Box box = box_of(rays, f.arm, 4);
    D density = clamp(gather(P.primitives.density, 1, rows), 0.0, kLargestDensity);
    const ScreenFilter<kRays> filter(rays, box);
    if (view.screen_filter > 0) {
      filter.grow(rays, box);
      density *= filter.scale_x * filter.scale_y;
    }
    if constexpr (kExact) clip_boxes<false>(view, center, f.arm, 4, rays.crosses_near, lanes, box);
    B visible = (B)(f.smallest > 0.0) & (kExact ? (B)(center[2] + f.high_z > view.near) : (B)(center[2] > view.near));
    Footprint* print = P.footprints + first;
    set_boxes(view, box.low_x, box.high_x, box.low_y, box.high_y, lanes, visible, print);
    D nearest = center[2] + f.low_z;
    if constexpr (!kExact) {
      D least = splat(0.0);
      for (int j = 0; j < 4; ++j) least = vmin(least, dot(rays.held, f.arm[j]));
      nearest = rays.length + least * rays.inverse_held;
    }
    const D key = order_key(rays, nearest, longest);
    for (int l = 0; l < lanes; ++l) {
      P.key[first + l] = Real(key[l]);
      Real* color = P.color + 3 * (first + l);
      color[0] = color[1] = color[2] = 0;
    }
    if (!any(visible)) continue;

    const TetrahedronPlanes<kRays> planes(f, rays, filter);
    B front[4];
    for (int j = 0; j < 4; ++j) front[j] = (B)(planes.h[j] < 0.0);
    // Silhouette: every edge between a front and a back face.
    D line_a[6], line_b[6], line_c[6];
    for (int i = 0, at = 0; i < 4; ++i)
      for (int j = i + 1; j < 4; ++j, ++at) {
        const D side = front[i] ? splat(1.0) : splat(-1.0);
        const B edge = front[i] ^ front[j];
        line_a[at] = edge ? side * (planes.a[i] - planes.a[j]) : splat(1.0);
        line_b[at] = edge ? side * (planes.b[i] - planes.b[j]) : splat(0.0);
        line_c[at] = edge ? side * (planes.c[i] - planes.c[j]) : splat(0.0);
      }
    set_lines(line_a, line_b, line_c, 6, lanes, print);

    Record* record = records + first;
    D fields[12];
    for (int j = 0; j < 4; ++j) fields[j] = planes.a[j], fields[4 + j] = planes.b[j], fields[8 + j] = planes.c[j];
    to_rows(&record[0].a[0], kRow, fields, 12, lanes);
    for (int l = 0; l < lanes; ++l) {
      record[l].w0 = Real(rays.w0[l]), record[l].density = Real(density[l]);
      record[l].ref_x = Real(rays.ref_x[l]), record[l].ref_y = Real(rays.ref_y[l]);
      print[l].ref_x = int(rays.ref_x[l]), print[l].ref_y = int(rays.ref_y[l]);
      record[l].flags =
          (front[0][l] ? 1u : 0u) | (front[1][l] ? 2u : 0u) | (front[2][l] ? 4u : 0u) | (front[3][l] ? 8u : 0u);
    }
    evaluate_color(eye, f.pose, P.primitives, first, lanes, visible, P.color, &record[0].rgb[0], kRow);
    if (P.normals)
      for (int j = 0; j < 4; ++j) {
        const D inverse = 1.0 / vsqrt(dot(f.n[j], f.n[j]));
        for (int i = 0; i < 3; ++i)
          for (int l = 0; l < lanes; ++l) P.normals[first + l][j][i] = Real(f.n[j][i][l] * inverse[l]);
      }
  }
}

template <class Real, RayModel kRays>
void project_tetrahedra_backward(const ProjectBackwardParams<Real>& P, int64_t begin, int64_t end) {
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

    const TetrahedronFrame f(view, P.primitives, rows);
    const RayFrame<kRays> rays(view, f.pose.center, -f.low_z);
    const bool filtered = view.screen_filter > 0;
    const Box box = filtered ? box_of(rays, f.arm, 4) : Box{};
    ScreenFilter<kRays> filter(rays, box);
    const TetrahedronPlanes<kRays> planes(f, rays, filter);
    RowGradients out{};
    D n_grad[4][3] = {};
    for (int j = 0; j < 4; ++j) {
      // w = (p - kappa) / h.
      const D inverse = 1.0 / planes.h[j], g = sum(j) * inverse;
      D gx = sum(4 + j) * inverse, gy = sum(8 + j) * inverse;
      const D g_h = -(planes.a[j] * g + planes.b[j] * gx + planes.c[j] * gy);
      if (filtered) filter.apply_grad(planes.px[j], planes.py[j], g, gx, gy);
      rays.form_grad(f.n[j], g, gx, gy, g_h, n_grad[j], out.center);
      if (geometry) {
        D q[3];
        for (int i = 0; i < 3; ++i) q[i] = sum(Sum::normal + 3 * j + i);
        const D length2 = dot(f.n[j], f.n[j]), along = dot(f.n[j], q) / length2, unit = 1.0 / vsqrt(length2);
        for (int i = 0; i < 3; ++i) n_grad[j][i] += (q[i] - f.n[j][i] * along) * unit;
      }
    }
    if constexpr (kRays == RayModel::kAffine)
      if (geometry)
        for (int i = 0; i < 3; ++i) out.center[i] += sum(Sum::distance) * f.pose.center[i] * rays.inverse_length;
    D e_grad[4][3];
    for (int i = 0; i < 4; ++i) {
      D along{}, others[3] = {}, shares{};  // over the faces that contain vertex i; shares: over the other vertices
      for (int j = 0; j < 4; ++j) {
        if (j == i) continue;
        shares += f.u[j];
        for (int t = 0; t < 3; ++t) along += n_grad[j][t] * (f.e[i][t] - f.e[j][t]), others[t] += n_grad[j][t];
      }
      out.extent[i] = -0.75 * along * f.u[i] * f.u[i];
      for (int t = 0; t < 3; ++t) e_grad[i][t] = 0.75 * (f.u[i] * others[t] - shares * n_grad[i][t]);
    }
    out.density = sum(Sum::density);
    if (filtered) {
      D arm_grad[4][3] = {};
      const D density = clamp(gather(P.primitives.density, 1, rows), 0.0, kLargestDensity);
      filter.finish(rays, box, f.arm, 4, density, out.density, arm_grad, out.center);
      out.density *= filter.scale_x * filter.scale_y;
      for (int j = 0; j < 4; ++j) {
        out.extent[j] += dot(arm_grad[j], f.e[j]);
        for (int i = 0; i < 3; ++i) e_grad[j][i] += arm_grad[j][i] * f.extent[j];
      }
    }
    for (int k = 0; k < 3; ++k)
      for (int i = 0; i < 3; ++i)
        out.axis[k][i] = kDirection[0][k] * e_grad[0][i] + kDirection[1][k] * e_grad[1][i] +
                         kDirection[2][k] * e_grad[2][i] + kDirection[3][k] * e_grad[3][i];
    // Screen-space gradients, total and per tile: as if the centre moved at its depth, or at the middle of the depths
    // beyond the near plane.
    const D z = rays.crosses_near ? (view.near + f.pose.center[2] + f.high_z) * 0.5 : f.pose.center[2];
    out.screen_x = out.center[0] * z * (1.0 / view.fx), out.screen_y = out.center[1] * z * (1.0 / view.fy);
    double pull[kLanes] = {};
    for (int l = 0; l < lanes; ++l) {
      const Real* slot = P.sums + int64_t(P.first_slot[first + l]) * P.sums_per_slot;
      for (uint32_t s = 0; s < P.slot_count[first + l]; ++s, slot += P.sums_per_slot) {
        double x = 0, y = 0;
        for (int j = 0; j < 4; ++j) {
          double g = double(slot[j]);
          if constexpr (kRays == RayModel::kExact) {
            g = rays.w0[l] * g + planes.a[j][l] * g + planes.b[j][l] * double(slot[4 + j]) +
                planes.c[j][l] * double(slot[8 + j]);
          }
          x -= g * f.n[j][0][l] / planes.h[j][l], y -= g * f.n[j][1][l] / planes.h[j][l];
        }
        pull[l] += z[l] * std::sqrt((x / view.fx) * (x / view.fx) + (y / view.fy) * (y / view.fy));
      }
    }
    write_rows(P, eye, f.pose, out, first, lanes, sums, pull);
  }
}

}  // namespace linprim::LINPRIM_ISA
