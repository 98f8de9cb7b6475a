// Gaussians: how a tile kernel evaluates the projected ellipse of 3D Gaussian splatting, how a Gaussian is projected to
// a record for that, and the backward passes of both.
//
// A Gaussian is not a solid: it has an alpha per pixel and a single depth, that of its centre. alpha = min(0.99,
// opacity exp(-d^T Q d / 2)), nothing below 1/255, with d the pixel's offset from the projected centre and Q the
// inverse of the projected covariance. Source: Kerbl et al. 2023 (arXiv 2308.04079), sections 4 and 6; the two limits
// are those of its appendix C.
//
// The covariance sum_k arm_k arm_k^T (arm_k is the local axis k times its standard deviation) is projected with the
// Jacobian J of the pixel position at the centre; for centres far outside of the image, where J diverges, at the
// nearest position within a margin around it. With g_k = J arm_k, M = sum_k g_k g_k^T + filter I. Source: Zwicker et
// al. 2002; Kerbl et al. 2023, equation 5.
#pragma once

#include "base/simd.h"
#include "primitives/primitive_pose.h"

namespace linprim::LINPRIM_ISA {

// A projected Gaussian as the tile kernels read it.
template <class Real>
struct alignas(16) GaussianRecord {
  Real xx, xy, yy;           // inverse covariance, 1 / pixel^2
  Real mean_x, mean_y;       // projected centre, relative to the reference
  Real w0, density, rgb[3];  // depth of the centre, peak opacity, colour
  Real ref_x, ref_y;
};

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

  struct Intersection {
    V dx, dy, falloff, alpha;
    I in_face;  // the one normal
  };

  template <bool kTrack>
  static M intersect(const Record& r, const View&, V x, V y, V, Intersection& m) {
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
  static V thickness(const Record&, V, M hit, Intersection& m) {
    return select(hit, min(m.alpha, V::set(Real(kLargestAlpha))), V::set(0));
  }
  static void attenuate(const Record&, V absorbed, V& alpha, V& through) {
    alpha = absorbed, through = V::set(1) - absorbed;
  }
  static void depths(const Record& r, V, const Intersection&, V& t_in, V& t_out) { t_in = t_out = V::set(r.w0); }

  // With g the gradient to the exponent: adds the sums of g dx dx, g dx dy, g dy dy, g dx, g dy at 0-4; d_tau is the
  // gradient to -ln(1 - alpha).
  template <class Kind, bool kDistance>
  static void add_gradient(const Record&, const Intersection& m, M hit, V, V through, V d_tau, V d_in, V d_out, V, V, V,
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

// A projected covariance whose determinant is below this share of its squared trace is a line and not drawn.
constexpr double kFlat = 1e-12;

struct GaussianFrame {
  Pose pose;
  D extent[3];
  D inverse_z, u, v;   // of the centre; z = 1 where it lies before the near plane
  D limit_u, limit_v;  // u and v held in view
  B in_front;
  D gx[3], gy[3];  // projected arms, pixels
  D xx, xy, yy;    // covariance, pixels^2
  D determinant;
  B drawn;

  template <class Real>
  GaussianFrame(const View& view, const Primitives<Real>& p, const int64_t* rows) {
    set_pose(view, p, rows, pose);
    in_front = (B)(pose.center[2] > view.near);
    inverse_z = 1.0 / (in_front ? pose.center[2] : splat(1.0));
    u = pose.center[0] * inverse_z, v = pose.center[1] * inverse_z;
    limit_u = held_in_view(u, view.width, view.cx, view.fx), limit_v = held_in_view(v, view.height, view.cy, view.fy);
    xx = yy = splat(view.screen_filter), xy = splat(0.0);
    D smallest = splat(1e300);
    for (int k = 0; k < 3; ++k) {
      const D raw = gather(p.extent + k, 3, rows);
      smallest = vmin(smallest, raw);
      extent[k] = clamp(raw, 0.0, kLargestExtent);
      gx[k] = view.fx * (pose.axis[k][0] - limit_u * pose.axis[k][2]) * inverse_z * extent[k];
      gy[k] = view.fy * (pose.axis[k][1] - limit_v * pose.axis[k][2]) * inverse_z * extent[k];
      xx += gx[k] * gx[k], xy += gx[k] * gy[k], yy += gy[k] * gy[k];
    }
    // By the Cauchy-Binet formula, without the cancellation of xx yy - xy^2.
    const D trace = xx + yy,
            across[3] = {gx[1] * gy[2] - gx[2] * gy[1], gx[2] * gy[0] - gx[0] * gy[2], gx[0] * gy[1] - gx[1] * gy[0]};
    determinant = dot(across, across) + view.screen_filter * (trace - view.screen_filter);
    drawn = in_front & (B)(smallest >= 0.0) & (B)(determinant > kFlat * trace * trace);
    determinant = drawn ? determinant : splat(1.0);
  }
  // Axis of the smallest standard deviation.
  B shortest(int k) const {
    B is = ~B{};
    for (int i = 0; i < 3; ++i)
      if (i != k) is &= i < k ? (B)(extent[k] < extent[i]) : (B)(extent[k] <= extent[i]);
    return is;
  }
};

template <class Real>
void project_gaussians(const ProjectParams<Real>& P, int64_t begin, int64_t end) {
  using Record = GaussianRecord<Real>;
  constexpr int kRow = sizeof(Record) / sizeof(Real);
  const View& view = P.view;
  const Eye eye(view);
  Record* records = static_cast<Record*>(P.records);

  for (int64_t first = begin; first < end; first += kLanes) {
    const int lanes = int(std::min<int64_t>(kLanes, end - first));
    int64_t rows[kLanes];
    for (int l = 0; l < kLanes; ++l) rows[l] = first + std::min(l, lanes - 1);
    const GaussianFrame f(view, P.primitives, rows);
    const D opacity = clamp(gather(P.primitives.density, 1, rows), 0.0, 1.0);
    const D x = view.fx * f.u + (view.cx - 0.5), y = view.fy * f.v + (view.cy - 0.5);

    // alpha is at least 1/255 where d^T Q d <= reach^2 = 2 ln(255 opacity): within +-reach sqrt(M_xx) along x and,
    // along a unit vector e, within +-reach sqrt(e^T M e).
    D reach{};
    for (int l = 0; l < kLanes; ++l)
      reach[l] = opacity[l] > kSmallestAlpha ? std::sqrt(2 * std::log(opacity[l] / kSmallestAlpha)) : 0.0;
    const D half_x = reach * vsqrt(f.xx), half_y = reach * vsqrt(f.yy);
    B visible = f.drawn & (B)(opacity >= kSmallestAlpha);
    Footprint* print = P.footprints + first;
    set_boxes(view, x - half_x, x + half_x, y - half_y, y + half_y, lanes, visible, print);
    for (int l = 0; l < lanes; ++l) {
      P.key[first + l] = Real(f.pose.center[2][l]);
      Real* color = P.color + 3 * (first + l);
      color[0] = color[1] = color[2] = 0;
    }
    if (!any(visible)) continue;

    const D ref_x = __builtin_convertvector(floor_of(clamp(x, -4e6, 4e6) + 0.5), D),
            ref_y = __builtin_convertvector(floor_of(clamp(y, -4e6, 4e6) + 0.5), D);
    const D mean_x = x - ref_x, mean_y = y - ref_y;
    // Four half-planes perpendicular to the ellipse's principal directions bound it.
    const D middle = 0.5 * (f.xx + f.yy), swing = vsqrt(0.25 * (f.xx - f.yy) * (f.xx - f.yy) + f.xy * f.xy);
    D ex = f.xx >= f.yy ? f.xx - f.yy + 2.0 * swing : 2.0 * f.xy,
      ey = f.xx >= f.yy ? 2.0 * f.xy : f.yy - f.xx + 2.0 * swing;
    const D length = vsqrt(ex * ex + ey * ey);
    ex = length > 0.0 ? ex / length : splat(1.0), ey = length > 0.0 ? ey / length : splat(0.0);
    D line_a[4], line_b[4], line_c[4];
    for (int e = 0; e < 4; ++e) {
      const D nx = (e & 1 ? -1.0 : 1.0) * (e < 2 ? ex : -ey), ny = (e & 1 ? -1.0 : 1.0) * (e < 2 ? ey : ex);
      const D spread = e < 2 ? middle + swing : vmax(middle - swing, f.determinant / (middle + swing));
      line_a[e] = reach * vsqrt(spread) + nx * mean_x + ny * mean_y + kPixelSlack, line_b[e] = -nx, line_c[e] = -ny;
    }
    set_lines(line_a, line_b, line_c, 4, lanes, print);

    const D inverse = 1.0 / f.determinant;
    const D fields[5] = {f.yy * inverse, -f.xy * inverse, f.xx * inverse, mean_x, mean_y};
    Record* record = records + first;
    to_rows(&record[0].xx, kRow, fields, 5, lanes);
    for (int l = 0; l < lanes; ++l) {
      record[l].w0 = Real(f.pose.center[2][l]), record[l].density = Real(opacity[l]);
      record[l].ref_x = Real(ref_x[l]), record[l].ref_y = Real(ref_y[l]);
      print[l].ref_x = int(ref_x[l]), print[l].ref_y = int(ref_y[l]);
    }
    evaluate_color(eye, f.pose, P.primitives, first, lanes, visible, P.color, &record[0].rgb[0], kRow);
    if (P.normals)
      for (int k = 0; k < 3; ++k) {
        const B mine = f.shortest(k);
        const D towards = dot(f.pose.axis[k], f.pose.center) > 0.0 ? splat(-1.0) : splat(1.0);
        for (int l = 0; l < lanes; ++l)
          if (mine[l])
            for (int i = 0; i < 3; ++i) P.normals[first + l][0][i] = Real(f.pose.axis[k][i][l] * towards[l]);
      }
  }
}

template <class Real>
void project_gaussians_backward(const ProjectBackwardParams<Real>& P, int64_t begin, int64_t end) {
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

    const GaussianFrame f(view, P.primitives, rows);
    const D inverse = 1.0 / f.determinant;
    const D qxx = f.yy * inverse, qxy = -f.xy * inverse, qyy = f.xx * inverse;  // inverse covariance
    // exponent = -(qxx dx^2 + 2 qxy dx dy + qyy dy^2) / 2, so with S = sum g d d^T the gradient to Q is -S/2 and to M
    // it is Q S Q / 2.
    const D sxx = sum(0), sxy = sum(1), syy = sum(2);
    const D rxx = qxx * sxx + qxy * sxy, rxy = qxx * sxy + qxy * syy, ryx = qxy * sxx + qyy * sxy,
            ryy = qxy * sxy + qyy * syy;  // Q S
    const D mxx = 0.5 * (rxx * qxx + rxy * qxy), mxy = 0.5 * (rxx * qxy + rxy * qyy),
            myy = 0.5 * (ryx * qxy + ryy * qyy);
    const D g_x = qxx * sum(3) + qxy * sum(4), g_y = qxy * sum(3) + qyy * sum(4);  // to the projected centre

    RowGradients out{};
    D g_u = g_x * view.fx, g_v = g_y * view.fy, g_inverse_z{};
    for (int k = 0; k < 3; ++k) {
      const D to_x = 2.0 * (mxx * f.gx[k] + mxy * f.gy[k]) * view.fx,
              to_y = 2.0 * (mxy * f.gx[k] + myy * f.gy[k]) * view.fy;
      const D* axis = f.pose.axis[k];
      const D arm_x = (axis[0] - f.limit_u * axis[2]) * f.extent[k],
              arm_y = (axis[1] - f.limit_v * axis[2]) * f.extent[k];
      const D ax = to_x * f.inverse_z, ay = to_y * f.inverse_z;
      out.axis[k][0] = ax * f.extent[k], out.axis[k][1] = ay * f.extent[k],
      out.axis[k][2] = -(ax * f.limit_u + ay * f.limit_v) * f.extent[k];
      out.extent[k] = ax * (axis[0] - f.limit_u * axis[2]) + ay * (axis[1] - f.limit_v * axis[2]);
      g_u -= f.u == f.limit_u ? ax * axis[2] * f.extent[k] : splat(0.0),
          g_v -= f.v == f.limit_v ? ay * axis[2] * f.extent[k] : splat(0.0);
      g_inverse_z += to_x * arm_x + to_y * arm_y;
    }
    g_inverse_z += g_u * f.pose.center[0] + g_v * f.pose.center[1];
    out.center[0] = g_u * f.inverse_z, out.center[1] = g_v * f.inverse_z,
    out.center[2] = -g_inverse_z * f.inverse_z * f.inverse_z;
    out.density = sum(Sum::density);
    if (geometry) {
      out.center[2] += sum(Sum::distance);
      for (int k = 0; k < 3; ++k) {
        const D towards = dot(f.pose.axis[k], f.pose.center) > 0.0 ? splat(-1.0) : splat(1.0);
        const B mine = f.shortest(k);
        for (int i = 0; i < 3; ++i) out.axis[k][i] += mine ? towards * sum(Sum::normal + i) : splat(0.0);
      }
    }
    out.screen_x = g_x, out.screen_y = g_y;
    double pull[kLanes] = {};
    for (int l = 0; l < lanes; ++l) {
      const Real* slot = P.sums + int64_t(P.first_slot[first + l]) * P.sums_per_slot;
      for (uint32_t s = 0; s < P.slot_count[first + l]; ++s, slot += P.sums_per_slot) {
        const double x = qxx[l] * double(slot[3]) + qxy[l] * double(slot[4]),
                     y = qxy[l] * double(slot[3]) + qyy[l] * double(slot[4]);
        pull[l] += std::sqrt(x * x + y * y);
      }
    }
    write_rows(P, eye, f.pose, out, first, lanes, sums, pull);
    for (int l = 0; l < lanes; ++l)
      if (P.slot_count[first + l] && double(P.primitives.density[first + l]) > 1) P.out.density[first + l] = 0;
  }
}

}  // namespace linprim::LINPRIM_ISA
