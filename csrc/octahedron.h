// How a tile kernel meets an octahedron: entry and exit of the rays of 16, 8, 4 or 1 pixels, and the adjoint of that.
//
// Another primitive kind or ray model is another struct with the same members. Included by raster.h only.
#pragma once

#include "kernels.h"
#include "simd.h"

namespace linprim::LINPRIM_ISA {

// Entry index of a ray that enters through the near plane; faces are 0-7.
constexpr int kNearPlane = 8;
// The lowest inverse depth a ray can leave at: keeps 1 / w finite.
constexpr double kFarInverse = 1e-12;

// Offsets of the pixels of a part of a 4x4 block from its first pixel.
template <class Real, int W>
struct Lanes {
  static constexpr int kPartWidth = W < kBlock ? W : kBlock;
  Vec<Real, W> x, y;
  Lanes() {
    alignas(64) Real lx[W], ly[W];
    for (int i = 0; i < W; ++i) lx[i] = Real(i % kPartWidth), ly[i] = Real(i / kPartWidth);
    x = Vec<Real, W>::load(lx), y = Vec<Real, W>::load(ly);
  }
};

template <class Real, int W, RayModel kRays>
struct Octahedron;

// An octahedron, its rays in exact perspective, moved to one tile: face values at the tile's first pixel, and each face's slope over
// the lanes of a part. This is what the tile kernels ask of a primitive kind: set, intersect, add_gradient and recenter.
template <class RealType, int W>
struct Octahedron<RealType, W, RayModel::kExact> {
  using Real = RealType;
  using V = Vec<Real, W>;
  using I = Index<Real, W>;
  static constexpr int kWidth = W;
  typedef Real Eight __attribute__((vector_size(8 * sizeof(Real))));
  alignas(64) Real corner[8], bx[8], cy[8];
  V slope[8];
  V w0, near_w, far_w;
  uint32_t flags;
  void set(const Record<Real>& r, int tile_x, int tile_y, const Lanes<Real, W>& lanes, const View& view) {
    const Real dx = Real(tile_x - r.ref_x), dy = Real(tile_y - r.ref_y);
    for (int f = 0; f < 8; ++f) {
      bx[f] = r.b[f], cy[f] = r.c[f];
      corner[f] = r.a[f] + (r.b[f] * dx + r.c[f] * dy);
    }
    for (int f = 0; f < 8; ++f) slope[f] = fma(V::set(r.b[f]), lanes.x, V::set(r.c[f]) * lanes.y);
    w0 = V::set(r.w0);
    flags = r.flags;
    near_w = V::set(Real(1 / view.near) - r.w0);
    far_w = V::set(Real(kFarInverse) - r.w0);
  }
  // Inverse depths, relative to w0, where the rays of a part whose first pixel lies (x, y) pixels into the tile enter and leave.
  template <bool kTrack>
  void intersect(Real x, Real y, V& in, V& out, I& in_face, I& out_face) const {
    alignas(64) Real at[8];
    if constexpr (W >= 8) {
      // Eight sums as one vector, then eight loads that broadcast: cheaper than eight scalar sums.
      *reinterpret_cast<Eight*>(at) = *reinterpret_cast<const Eight*>(corner) +
                                      (*reinterpret_cast<const Eight*>(bx) * x + *reinterpret_cast<const Eight*>(cy) * y);
      asm("" : "+m"(at));  // keeps the compiler from taking the vector apart in registers
    } else {
      for (int f = 0; f < 8; ++f) at[f] = corner[f] + (bx[f] * x + cy[f] * y);
    }
    auto value = [&](int f) { return V::set(at[f]) + slope[f]; };
    auto enter = [&](V w, int f) {
      if constexpr (kTrack) in_face = select(w < in, I::set(f), in_face);
      in = min(w, in);
    };
    auto leave = [&](V w, int f) {
      if constexpr (kTrack) out_face = select(out < w, I::set(f), out_face);
      out = max(w, out);
    };
    if (!(flags & kGeneral)) [[likely]] {
      in = value(0), out = value(4);
      if constexpr (kTrack) in_face = I::set(0), out_face = I::set(4);
      for (int f = 1; f < 4; ++f) enter(value(f), f), leave(value(4 + f), 4 + f);
    } else {
      in = near_w, out = far_w;
      if constexpr (kTrack) in_face = I::set(kNearPlane), out_face = I::set(kNearPlane);
      for (int f = 0; f < 8; ++f) {
        if (f < 4 && (flags >> f & 1)) {
          enter(value(f), f);
        } else {
          leave(value(f), f);
        }
      }
    }
  }
  // Adds the gradients g_in and g_out to the inverse depths of entry and exit (0 in lanes without a hit), and the same times those
  // depths, to the sums of the three local forms; px and py are positions in the tile.
  void add_gradient(const Record<Real>& record, I in_face, I out_face, V g_in, V g_out, V g_in_w, V g_out_w, V px, V py, V* sums) const {
    for (int k = 0; k < 3; ++k) {
      const V s_in = lookup8(record.face[k], in_face), s_out = lookup8(record.face[k], out_face);
      const V g = fma(g_in, s_in, g_out * s_out);
      sums[Sum::g + k] = sums[Sum::g + k] + g;
      sums[Sum::gx + k] = fma(g, px, sums[Sum::gx + k]);
      sums[Sum::gy + k] = fma(g, py, sums[Sum::gy + k]);
      sums[Sum::gw + k] = fma(g_in_w, s_in, fma(g_out_w, s_out, sums[Sum::gw + k]));
    }
  }
  // Positions were counted from the tile's corner: moves a slot's sums to the reference pixel.
  static void recenter(const Record<Real>& record, int tile_x, int tile_y, Real* slot) {
    const Real dx = Real(tile_x - record.ref_x), dy = Real(tile_y - record.ref_y);
    for (int k = 0; k < 3; ++k) slot[Sum::gx + k] += dx * slot[Sum::g + k], slot[Sum::gy + k] += dy * slot[Sum::g + k];
  }
};

}  // namespace linprim::LINPRIM_ISA
