// Common parts of projecting polyhedra: face planes over the pixels for both ray models, screen boxes, the screen
// filter; each with its backward pass next to it.
//
// A face is the plane n . (x - c) = 1 in camera space. Its w over the pixels (see polyhedron.h) is (p - kappa) / h with
// p affine in the pixel and both p and h linear in n:
//   exact rays   p = n . (v - w0 c), kappa = w0, h = 1 + m, m = n . c           (w = inverse depth - w0)
//   affine rays  p = n'_u (u - u_c) + n'_v (v - v_c), kappa = 1, h = m, m = n . j / |j|,   n' = J^-T n   (w = |c| -
//   distance)
// J is the Jacobian of (x/z, y/z, |x|) at j, the ray space of EWA splatting (Zwicker et al. 2002, section 4). j is the
// centre c or, as for Gaussians, the nearest position at its depth within a margin around the image: beyond, J grows
// without bound and small primitives would cover the image.
#pragma once

#include "primitives/primitive_pose.h"

namespace linprim::LINPRIM_ISA {

// A face seen edge-on would divide by h = 0; |h| is kept above this share of its largest term.
constexpr double kEdgeOn = 1e-6;

// Moves h away from 0, keeping its sign; `size` is the size of its largest term.
inline D off_edge(D h, D size) {
  const D floor = kEdgeOn * size;
  return vabs(h) < floor ? (h < 0.0 ? -floor : floor) : h;
}

template <RayModel kRays>
struct RayFrame {
  static constexpr bool kExact = kRays == RayModel::kExact;
  const View& view;
  const D* c;      // centre, camera space
  D ref_x, ref_y;  // reference pixel: the one nearest to the projected centre
  D w0, kappa;
  D base[3];                            // exact: v_ref - w0 c; affine: (u_ref - u_c, v_ref - v_c, 0)
  D inverse_z, length, inverse_length;  // affine: 1/z, |c|, 1/|c|
  D held[3], inverse_held;              // affine: j, 1/|j|
  B free[2];                            // affine: j follows x, y of the centre
  B crosses_near;                       // exact: w0 = 0 and the reference is the principal point

  // `reach` is the extent of the primitive from its centre along z, in both directions.
  RayFrame(const View& v, const D center[3], D reach) : view(v), c(center) {
    crosses_near = kExact ? (B)(c[2] - reach < view.near) : B{};
    const D safe_z = kExact ? (crosses_near ? splat(1.0) : c[2]) : (c[2] > view.near ? c[2] : splat(1.0));
    inverse_z = 1.0 / safe_z;
    const D x = view.fx * c[0] * inverse_z + (view.cx - 0.5), y = view.fy * c[1] * inverse_z + (view.cy - 0.5);
    // A reference far outside the image only loses precision where nothing is drawn.
    ref_x = nearest(crosses_near ? splat(std::floor(view.cx)) : x),
    ref_y = nearest(crosses_near ? splat(std::floor(view.cy)) : y);
    const D u = (ref_x + (0.5 - view.cx)) * (1.0 / view.fx), v_ref = (ref_y + (0.5 - view.cy)) * (1.0 / view.fy);
    if constexpr (kExact) {
      w0 = kappa = crosses_near ? splat(0.0) : inverse_z;
      base[0] = u - c[0] * w0, base[1] = v_ref - c[1] * w0, base[2] = 1.0 - c[2] * w0;
    } else {
      const D length2 = dot(c, c);
      length = vsqrt(length2 == 0.0 ? splat(1.0) : length2), inverse_length = 1.0 / length;
      w0 = length, kappa = splat(1.0);
      base[0] = u - c[0] * inverse_z, base[1] = v_ref - c[1] * inverse_z, base[2] = splat(0.0);
      hold(view, c, held, free);
      inverse_held = 1.0 / vsqrt(dot(held, held));
    }
  }
  static D nearest(D x) { return __builtin_convertvector(floor_of(clamp(x, -4e6, 4e6) + 0.5), D); }
  static void hold(const View& view, const D c[3], D held[3], B free[2]) {
    const D z = c[2] > view.near ? c[2] : splat(1.0), inverse = 1.0 / z, u = c[0] * inverse, v = c[1] * inverse;
    const D held_u = held_in_view(u, view.width, view.cx, view.fx),
            held_v = held_in_view(v, view.height, view.cy, view.fy);
    free[0] = (B)(u == held_u), free[1] = (B)(v == held_v);
    held[0] = free[0] ? c[0] : held_u * z, held[1] = free[1] ? c[1] : held_v * z, held[2] = z;
  }
  // Computes p at the reference pixel, its steps per pixel, and m.
  void form(const D n[3], D& p, D& px, D& py, D& m) const {
    if constexpr (kExact) {
      p = dot(n, base), px = n[0] * (1.0 / view.fx), py = n[1] * (1.0 / view.fy), m = dot(n, c);
    } else {
      const D along = dot(n, held), share = held[2] * inverse_held * inverse_held * along;
      const D nu = held[2] * n[0] - held[0] * share, nv = held[2] * n[1] - held[1] * share;
      p = nu * base[0] + nv * base[1], px = nu * (1.0 / view.fx), py = nv * (1.0 / view.fy), m = along * inverse_held;
    }
  }
  // Adds to the gradients of n and c.
  void form_grad(const D n[3], D g, D gx, D gy, D gm, D n_grad[3], D c_grad[3]) const {
    if constexpr (kExact) {
      for (int i = 0; i < 3; ++i) n_grad[i] += g * base[i] + gm * c[i], c_grad[i] += (gm - w0 * g) * n[i];
      n_grad[0] += gx * (1.0 / view.fx), n_grad[1] += gy * (1.0 / view.fy);
    } else {
      const D along = dot(n, held), l2 = inverse_held * inverse_held, share = held[2] * l2 * along;
      const D nu = held[2] * n[0] - held[0] * share, nv = held[2] * n[1] - held[1] * share;
      const D g_nu = g * base[0] + gx * (1.0 / view.fx), g_nv = g * base[1] + gy * (1.0 / view.fy);
      const D g_uc = -g * nu, g_vc = -g * nv;  // base = reference - (u_c, v_c)
      const D g_share = -(held[0] * g_nu + held[1] * g_nv);
      const D g_along = gm * inverse_held + g_share * held[2] * l2;
      n_grad[0] += held[2] * g_nu, n_grad[1] += held[2] * g_nv;
      D to[3] = {-share * g_nu, -share * g_nv, n[0] * g_nu + n[1] * g_nv + g_share * l2 * along};
      // |j|: m has its inverse, share its inverse square.
      const D radial = -(gm * along * l2 * inverse_held + 2.0 * g_share * share * l2);
      for (int i = 0; i < 3; ++i) n_grad[i] += held[i] * g_along, to[i] += n[i] * g_along + held[i] * radial;
      for (int i = 0; i < 2; ++i)
        c_grad[i] += free[i] ? to[i] : splat(0.0), c_grad[2] += free[i] ? splat(0.0) : to[i] * held[i] * inverse_z;
      c_grad[2] += to[2];
      add_centre(g_uc, g_vc, c_grad);
    }
  }
  // Adds the gradient through (x/z, y/z) of the centre.
  void add_centre(D g_u, D g_v, D c_grad[3]) const {
    c_grad[0] += g_u * inverse_z, c_grad[1] += g_v * inverse_z;
    c_grad[2] -= (g_u * c[0] + g_v * c[1]) * inverse_z * inverse_z;
  }
  // Projects c + arm to pixel indices with the ray model; the backward pass follows.
  void project(const D arm[3], D& x, D& y) const {
    if constexpr (kExact) {
      const D inverse = 1.0 / (crosses_near ? splat(1.0) : c[2] + arm[2]);
      x = view.fx * (c[0] + arm[0]) * inverse + (view.cx - 0.5),
      y = view.fy * (c[1] + arm[1]) * inverse + (view.cy - 0.5);
    } else {
      const D u = held[0] * inverse_z, v = held[1] * inverse_z;
      x = view.fx * (c[0] + arm[0] - u * arm[2]) * inverse_z + (view.cx - 0.5),
      y = view.fy * (c[1] + arm[1] - v * arm[2]) * inverse_z + (view.cy - 0.5);
    }
  }
  void project_grad(const D arm[3], D gx, D gy, D arm_grad[3], D c_grad[3]) const {
    gx *= view.fx, gy *= view.fy;
    if constexpr (kExact) {
      const D inverse = 1.0 / (crosses_near ? splat(1.0) : c[2] + arm[2]);
      const D to[3] = {gx * inverse, gy * inverse, -(gx * (c[0] + arm[0]) + gy * (c[1] + arm[1])) * inverse * inverse};
      for (int i = 0; i < 3; ++i) arm_grad[i] += to[i], c_grad[i] += to[i];
    } else {
      const D u = held[0] * inverse_z, v = held[1] * inverse_z;
      arm_grad[0] += gx * inverse_z, arm_grad[1] += gy * inverse_z, arm_grad[2] -= (gx * u + gy * v) * inverse_z;
      const D part = arm[2] * inverse_z;
      add_centre(free[0] ? gx * (1.0 - part) : gx, free[1] ? gy * (1.0 - part) : gy, c_grad);
      c_grad[2] -= (gx * (arm[0] - u * arm[2]) + gy * (arm[1] - v * arm[2])) * inverse_z * inverse_z;
    }
  }
};

// Screen box of the vertices c + arm[i], in pixel indices.
struct Box {
  D low_x, high_x, low_y, high_y;
};
template <RayModel kRays>
inline Box box_of(const RayFrame<kRays>& rays, const D (*arm)[3], int vertices) {
  Box box{splat(1e30), splat(-1e30), splat(1e30), splat(-1e30)};
  for (int i = 0; i < vertices; ++i) {
    D x, y;
    rays.project(arm[i], x, y);
    box.low_x = vmin(box.low_x, x), box.high_x = vmax(box.high_x, x), box.low_y = vmin(box.low_y, y),
    box.high_y = vmax(box.high_y, y);
  }
  return box;
}

// For lanes that cross the near plane: the screen box of the part beyond it, from the vertices there and the points
// where edges cross the plane. Every two vertices are connected by an edge except, with kOpposite, 2 k and 2 k + 1.
template <bool kOpposite>
inline void clip_boxes(const View& view, const D center[3], const D (*arm)[3], int vertices, B crosses, int lanes,
                       Box& box) {
  for (int l = 0; l < lanes; ++l) {
    if (!crosses[l]) continue;
    double low_x = 1e30, high_x = -1e30, low_y = 1e30, high_y = -1e30;
    auto add = [&](double x, double y, double z) {
      const double px = view.fx * x / z + (view.cx - 0.5), py = view.fy * y / z + (view.cy - 0.5);
      low_x = std::min(low_x, px), high_x = std::max(high_x, px), low_y = std::min(low_y, py),
      high_y = std::max(high_y, py);
    };
    double at[6][3];
    for (int i = 0; i < vertices; ++i)
      for (int k = 0; k < 3; ++k) at[i][k] = center[k][l] + arm[i][k][l];
    for (int i = 0; i < vertices; ++i) {
      if (at[i][2] >= view.near) add(at[i][0], at[i][1], at[i][2]);
      for (int j = i + 1; j < vertices; ++j) {
        if ((kOpposite && i / 2 == j / 2) || (at[i][2] >= view.near) == (at[j][2] >= view.near)) continue;
        const double part = (view.near - at[i][2]) / (at[j][2] - at[i][2]);
        add(at[i][0] + part * (at[j][0] - at[i][0]), at[i][1] + part * (at[j][1] - at[i][1]), view.near);
      }
    }
    // Face planes of primitives that cross the near plane are relative to inverse depth 0: one pixel covers their
    // rounding.
    box.low_x[l] = low_x - 1, box.high_x[l] = high_x + 1, box.low_y[l] = low_y - 1, box.high_y[l] = high_y + 1;
  }
}

// Screen filter: a pixel's ray intersects the primitive where the ray of (pixel - projected centre) * scale would, so
// its box grows by half the filter on every side. Density is multiplied by scale_x scale_y, which preserves the optical
// thickness summed over the screen.
template <RayModel kRays>
struct ScreenFilter {
  D scale_x, scale_y, half_x, half_y;
  D center_x, center_y;  // projected centre from the reference pixel
  double half;
  ScreenFilter(const RayFrame<kRays>& rays, const Box& box) : half(rays.view.screen_filter / 2) {
    half_x = 0.5 * (box.high_x - box.low_x), half_y = 0.5 * (box.high_y - box.low_y);
    scale_x = rays.crosses_near ? splat(1.0) : half_x / (half_x + half),
    scale_y = rays.crosses_near ? splat(1.0) : half_y / (half_y + half);
    const View& view = rays.view;
    center_x = rays.crosses_near ? splat(0.0) : view.fx * rays.c[0] * rays.inverse_z + (view.cx - 0.5) - rays.ref_x;
    center_y = rays.crosses_near ? splat(0.0) : view.fy * rays.c[1] * rays.inverse_z + (view.cy - 0.5) - rays.ref_y;
  }
  void apply(D& p, D& px, D& py) const {
    p += px * (1.0 - scale_x) * center_x + py * (1.0 - scale_y) * center_y;
    px *= scale_x, py *= scale_y;
  }
  void grow(const RayFrame<kRays>& rays, Box& box) const {
    const D x = center_x + rays.ref_x, y = center_y + rays.ref_y;
    box.low_x = x + (box.low_x - x) / scale_x, box.high_x = x + (box.high_x - x) / scale_x;
    box.low_y = y + (box.low_y - y) / scale_y, box.high_y = y + (box.high_y - y) / scale_y;
  }
  // Converts the gradients of a filtered form to those of the form; accumulates the gradients of scales and centre.
  D g_scale_x{}, g_scale_y{}, g_center_x{}, g_center_y{};
  void apply_grad(D px, D py, D g, D& gx, D& gy) {
    g_scale_x += px * (gx - g * center_x), g_scale_y += py * (gy - g * center_y);
    g_center_x += px * (1.0 - scale_x) * g, g_center_y += py * (1.0 - scale_y) * g;
    gx = g * (1.0 - scale_x) * center_x + gx * scale_x, gy = g * (1.0 - scale_y) * center_y + gy * scale_y;
  }
  // Adds the accumulated gradients, and the density's part, to the gradients of vertices and centre.
  void finish(const RayFrame<kRays>& rays, const Box& box, const D (*arm)[3], int vertices, D density, D density_grad,
              D (*arm_grad)[3], D c_grad[3]) {
    g_scale_x += density_grad * density * scale_y, g_scale_y += density_grad * density * scale_x;
    // scale = h / (h + half)
    const D g_half_x = rays.crosses_near ? splat(0.0) : g_scale_x * half / ((half_x + half) * (half_x + half));
    const D g_half_y = rays.crosses_near ? splat(0.0) : g_scale_y * half / ((half_y + half) * (half_y + half));
    B low_x{}, high_x{}, low_y{}, high_y{};  // found
    for (int i = 0; i < vertices; ++i) {
      D x, y;
      rays.project(arm[i], x, y);
      auto pick = [](D value, D limit, B& found) {
        const B here = (B)(value == limit) & ~found;
        found |= here;
        return here ? splat(0.5) : splat(0.0);
      };
      const D at_x = pick(x, box.high_x, high_x) - pick(x, box.low_x, low_x),
              at_y = pick(y, box.high_y, high_y) - pick(y, box.low_y, low_y);
      rays.project_grad(arm[i], g_half_x * at_x, g_half_y * at_y, arm_grad[i], c_grad);
    }
    rays.add_centre(rays.crosses_near ? splat(0.0) : g_center_x * rays.view.fx,
                    rays.crosses_near ? splat(0.0) : g_center_y * rays.view.fy, c_grad);
  }
};

// Returns the length of the longest ray (u, v, 1) of the image.
inline double longest_ray(const View& view) {
  const double u = std::max(std::fabs(0.5 - view.cx), std::fabs(view.width - 0.5 - view.cx)) / view.fx;
  const double v = std::max(std::fabs(0.5 - view.cy), std::fabs(view.height - 0.5 - view.cy)) / view.fy;
  return std::sqrt(1 + u * u + v * v);
}

// Sort key of the order: the depth of the centre, or a lower bound of the depth at which any ray meets the primitive.
// `nearest` is the smallest z (exact rays) or distance (affine) of its vertices.
template <RayModel kRays>
inline D order_key(const RayFrame<kRays>& rays, D nearest, double longest) {
  if (rays.view.order == Order::kCenter) return rays.c[2];
  if constexpr (kRays == RayModel::kExact) return vmax(nearest, splat(rays.view.near)) * (1 - kDepthSlack);
  return nearest * (nearest > 0.0 ? splat(1 / longest) : splat(1.0)) - kDepthSlack * rays.length;
}

}  // namespace linprim::LINPRIM_ISA
