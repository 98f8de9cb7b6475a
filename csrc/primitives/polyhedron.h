// Common parts of the polyhedra in a tile kernel: from the planes of entry and exit to depths and optical thickness,
// and the backward pass.
//
// A tile kernel needs from a primitive kind ("Kind"):
//   Record, Intersection, kVolume (absorbs along an interval), kColorSums and kGeometrySums per gradient slot
//   intersect     which lanes hit, and the intersection data that the functions below need
//   thickness     the absorbed amount, in the form that `attenuate` expects (0 in lanes without a hit)
//   attenuate     thickness to alpha and transmittance
//   depths        z-depths of entry and exit
//   add_gradient  from the gradients of thickness and depths to the pair's sums
//   recenter      converts a finished slot's sums from their origin to the record's reference
//
// The faces of a polyhedron are planes w_f(x, y) = a_f + b_f (x - ref_x) + c_f (y - ref_y), with x and y in pixels. For
// exact rays, w is the inverse depth minus w0, the inverse depth of the reference; for affine rays, the centre's
// distance w0 minus the distance. In both cases a ray is inside for w from the largest of the back faces to the
// smallest of the front faces.
#pragma once

#include "base/types.h"
#include "base/simd.h"

namespace linprim::LINPRIM_ISA {

// Face index for a ray that enters through the near plane; faces are 0-7.
constexpr int kNearPlane = 8;
// Smallest inverse depth at which a ray can leave: keeps 1 / w finite.
constexpr double kFarInverse = 1e-12;
// A value beyond every face plane of a primitive, for affine rays.
constexpr double kBeyond = 1e30;

template <class Real, int W, RayModel kRays>
struct Polyhedron {
  using V = Vec<Real, W>;
  using M = Mask<Real, W>;
  using I = Index<Real, W>;
  static constexpr int kWidth = W;
  static constexpr bool kVolume = true;
  static constexpr RayModel kRayModel = kRays;
  static constexpr int kColorSums = 16, kGeometrySums = 32;

  struct Intersection {
    V in, out;               // planes of entry and exit, in < out is a miss
    I in_face, out_face;     // where tracked
    V w_in, w_out, inverse;  // exact rays: inverse depths and 1 / (w_in w_out)
    V chord;                 // metric length inside
  };

  template <class Record>
  static V thickness(const Record& r, V length, M hit, Intersection& m) {
    if constexpr (kRays == RayModel::kExact) {
      m.w_in = m.in + V::set(r.w0), m.w_out = m.out + V::set(r.w0);
      m.inverse = rcp(m.w_in * m.w_out);
      m.chord = select(hit, length * (m.in - m.out) * m.inverse, V::set(0));
    } else {
      m.chord = select(hit, m.in - m.out, V::set(0));
    }
    return V::set(r.density) * m.chord;
  }
  template <class Record>
  static void attenuate(const Record&, V tau, V& alpha, V& through) {
    exp_neg(tau, alpha, through);
  }
  template <class Record>
  static void depths(const Record& r, V length, const Intersection& m, V& t_in, V& t_out) {
    if constexpr (kRays == RayModel::kExact) {
      t_in = m.w_out * m.inverse, t_out = m.w_in * m.inverse;
    } else {
      const V inverse = rcp(length);
      t_in = (V::set(r.w0) - m.in) * inverse, t_out = (V::set(r.w0) - m.out) * inverse;
    }
  }
  // Adds to the sums of Kind's record, from the gradients of optical thickness and of the z-depths of entry and exit (0
  // in lanes without a hit), and the density's additional gradient besides its share of the thickness. The unnamed
  // argument is the transmittance. kDistance: there is a sum for the centre's distance.
  template <class Kind, bool kDistance>
  static void add_gradient(const typename Kind::Record& r, const Intersection& m, M hit, V length, V, V d_tau, V d_in,
                           V d_out, V d_density, V px, V py, V* sums) {
    const V zero = V::set(0), d_chord = d_tau * V::set(r.density);
    sums[Sum::density] = fma(d_tau, m.chord, sums[Sum::density] + d_density);
    const M faced = hit & is_face(m.in_face);  // no face moves the entry through the near plane
    V g_in, g_out;
    if constexpr (kRays == RayModel::kExact) {
      // chord = |v| (t_out - t_in); w = 1/t, so dL/dw = -t^2 dL/dt.
      const V t_in = m.w_out * m.inverse, t_out = m.w_in * m.inverse, along = d_chord * length;
      g_in = select(faced, t_in * t_in * (along - d_in), zero);
      g_out = select(hit & is_face(m.out_face), zero - t_out * t_out * (along + d_out), zero);
    } else {
      // chord = in - out; t = (w0 - w) / |v|.
      const V inverse = rcp(length);
      g_in = select(hit, fma(zero - d_in, inverse, d_chord), zero);
      g_out = select(hit, zero - fma(d_out, inverse, d_chord), zero);
      if constexpr (kDistance) sums[Sum::distance] = fma(d_in + d_out, inverse, sums[Sum::distance]);
    }
    Kind::add_planes(r, m, hit, g_in, g_out, px, py, sums);
  }
};

}  // namespace linprim::LINPRIM_ISA
