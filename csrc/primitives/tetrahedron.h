// How a tile kernel meets a tetrahedron: entry and exit of the rays of 16, 8, 4 or 1 pixels, and the adjoint of that.
#pragma once

#include "primitives/polyhedron.h"

namespace linprim::LINPRIM_ISA {

template <class RealType, int W, RayModel kRays>
struct Tetrahedron : Polyhedron<RealType, W, kRays> {
  using Real = RealType;
  using Record = TetrahedronRecord<Real>;
  using Base = Polyhedron<Real, W, kRays>;
  using V = typename Base::V;
  using M = typename Base::M;
  using I = typename Base::I;
  using Meeting = typename Base::Meeting;

  // Planes where the rays enter and leave; x and y are counted in pixels from the record's reference. kTrack: also
  // which faces.
  template <bool kTrack>
  static M meet(const Record& r, const View& view, V x, V y, V, Meeting& m) {
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

  // Adds gradients to the planes of entry and exit (0 in lanes without a hit): with g the gradient to face f's plane,
  // the sums of g, g x and g y at f, 4 + f and 8 + f; px and py are positions from the pair's origin.
  static void add_planes(const Record&, const Meeting& m, M, V g_in, V g_out, V px, V py, V* sums) {
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

}  // namespace linprim::LINPRIM_ISA
