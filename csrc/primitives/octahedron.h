// How a tile kernel meets an octahedron: entry and exit of the rays of 16, 8, 4 or 1 pixels, and the adjoint of that.
#pragma once

#include "primitives/polyhedron.h"

namespace linprim::LINPRIM_ISA {

template <class RealType, int W, RayModel kRays>
struct Octahedron : Polyhedron<RealType, W, kRays> {
  using Real = RealType;
  using Record = OctahedronRecord<Real>;
  using Base = Polyhedron<Real, W, kRays>;
  using V = typename Base::V;
  using M = typename Base::M;
  using I = typename Base::I;
  using Meeting = typename Base::Meeting;

  // Planes where the rays enter and leave; x and y are counted in pixels from the record's reference. kTrack: also
  // which faces.
  template <bool kTrack>
  static M meet(const Record& r, const View& view, V x, V y, V, Meeting& m) {
    auto value = [&](int f) { return fma(V::set(r.b[f]), x, fma(V::set(r.c[f]), y, V::set(r.a[f]))); };
    auto enter = [&](V w, int f) {
      if constexpr (kTrack) m.in_face = select(w < m.in, I::set(f), m.in_face);
      m.in = min(w, m.in);
    };
    auto leave = [&](V w, int f) {
      if constexpr (kTrack) m.out_face = select(m.out < w, I::set(f), m.out_face);
      m.out = max(w, m.out);
    };
    // Under affine rays each pair of opposite faces has one that is turned to the camera, and nothing is cut.
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

  // Adds gradients to the planes of entry and exit (0 in lanes without a hit) to the sums of the three local forms p_k:
  // with g the gradient to p_k, the sums of g, g x, g y and g w at 0, 3, 6 and 9; px and py are positions from the
  // pair's origin.
  static void add_planes(const Record& r, const Meeting& m, M hit, V g_in, V g_out, V px, V py, V* sums) {
    // A lane that does not hit may hold an infinity, and 0 times that is no number.
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
  // Moves a slot's sums from their origin, a pixel of the tile, to the reference pixel.
  static void recenter(const Record& r, Real origin_x, Real origin_y, Real* slot) {
    const Real dx = origin_x - r.ref_x, dy = origin_y - r.ref_y;
    for (int k = 0; k < 3; ++k) slot[3 + k] += dx * slot[k], slot[6 + k] += dy * slot[k];
  }
};

}  // namespace linprim::LINPRIM_ISA
