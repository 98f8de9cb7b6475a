// How a tile kernel meets a Gaussian: 3D Gaussian splatting's projected ellipse, and the adjoint of that.
//
// Not a solid: it has an alpha per pixel and one depth, that of its centre. alpha = min(0.99, opacity exp(-d^T Q d /
// 2)), nothing below 1/255, d the pixel's offset from the projected centre and Q the inverse of the projected
// covariance. Source: Kerbl et al. 2023 (arXiv 2308.04079), sections 4 and 6; the two limits are those of its appendix
// C.
#pragma once

#include "base/types.h"
#include "base/simd.h"

namespace linprim::LINPRIM_ISA {

constexpr double kLargestAlpha = 0.99, kSmallestAlpha = 1.0 / 255;

template <class RealType, int W, RayModel kRays>
struct Gaussian {
  using Real = RealType;
  using V = Vec<Real, W>;
  using M = Mask<Real, W>;
  using I = Index<Real, W>;
  using Record = GaussianRecord<Real>;
  static constexpr int kWidth = W;
  static constexpr bool kVolume = false;
  static constexpr int kColorSums = 16, kGeometrySums = 32;

  struct Meeting {
    V dx, dy, falloff, alpha;
    I in_face;  // the one normal
  };

  template <bool kTrack>
  static M meet(const Record& r, const View&, V x, V y, V, Meeting& m) {
    m.dx = x - V::set(r.mean_x), m.dy = y - V::set(r.mean_y);
    const V half = V::set(Real(0.5));
    const V distance =
        fma(fma(V::set(r.xx) * half, m.dx, V::set(r.xy) * m.dy), m.dx, V::set(r.yy) * half * m.dy * m.dy);
    V unused;
    exp_neg(max(distance, V::set(0)), unused, m.falloff);
    m.alpha = V::set(r.density) * m.falloff;
    m.in_face = I::set(0);
    return m.alpha >= V::set(Real(kSmallestAlpha));
  }
  static V thickness(const Record&, V, M hit, Meeting& m) {
    return select(hit, min(m.alpha, V::set(Real(kLargestAlpha))), V::set(0));
  }
  static void attenuate(const Record&, V absorbed, V& alpha, V& through) {
    alpha = absorbed, through = V::set(1) - absorbed;
  }
  static void depths(const Record& r, V, const Meeting&, V& t_in, V& t_out) { t_in = t_out = V::set(r.w0); }

  // With g the gradient to the exponent: the sums of g dx dx, g dx dy, g dy dy, g dx, g dy at 0-4; d_tau is the
  // gradient to -ln(1 - alpha).
  template <class Kind, bool kDistance>
  static void add_gradient(const Record&, const Meeting& m, M hit, V, V through, V d_tau, V d_in, V d_out, V, V, V,
                           V* sums) {
    const M free = hit & (m.alpha < V::set(Real(kLargestAlpha)));
    const V d_alpha = select(free, d_tau * rcp(through), V::set(0)), g = d_alpha * m.alpha;
    const V gx = g * m.dx, gy = g * m.dy;
    sums[0] = fma(gx, m.dx, sums[0]), sums[1] = fma(gx, m.dy, sums[1]), sums[2] = fma(gy, m.dy, sums[2]);
    sums[3] = sums[3] + gx, sums[4] = sums[4] + gy;
    sums[Sum::density] = fma(d_alpha, m.falloff, sums[Sum::density]);
    if constexpr (kDistance) sums[Sum::distance] = sums[Sum::distance] + (d_in + d_out);
  }
  static void recenter(const Record&, Real, Real, Real*) {}
};

}  // namespace linprim::LINPRIM_ISA
