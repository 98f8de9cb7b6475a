// Depth maps at a given transmittance with exact overlap, for meshing: no order, no colour, no gradient.
#pragma once

#include <limits>

#include "raster/tile.h"

namespace linprim::LINPRIM_ISA {

// Computes where the transmittance of one tile's rays falls to `level`, with densities added up where primitives
// overlap: sum_i density_i |v| clamp(t - t_in_i, 0, t_out_i - t_in_i) = ln(1 / level). The sum does not depend on any
// order and grows with t, so the equation is solved by bisection. `scratch` holds 3 * 16 values per pair of the longest
// tile list. Writes out.depth_median, 0 if the level is never reached, and out.opacity, which does not depend on the
// order either.
template <class Kind>
void level_depth_tile(const RasterParams<typename Kind::Real>& P, int tile, typename Kind::Real* scratch) {
  using Real = typename Kind::Real;
  constexpr int W = Kind::kWidth;
  using T = Tile<Real, W>;
  using V = typename T::V;
  using M = typename T::M;
  using I = typename T::I;
  constexpr int kMostHalvings = sizeof(Real) == 4 ? 80 : 140;  // enough for any bracket; far fewer are usual
  const V resolution = V::set(Real(2) * std::numeric_limits<Real>::epsilon());
  const View& view = P.view;
  const int tile_x = tile % P.tiles_x * kTile, tile_y = tile / P.tiles_x * kTile;
  const Lanes<Real, W> lanes;
  const V zero = V::set(0), half = V::set(Real(0.5)), wanted = V::set(Real(-std::log(view.level)));
  alignas(64) Real length[kTilePixels], depth[kTilePixels], opacity[kTilePixels];
  T::ray_lengths(view, tile_x, tile_y, length);
  for (int block = 0; block < kBlocks; ++block)
    for (int part = 0; part < T::kParts; ++part) {
      const int at = block * 16 + part * W;
      const V x = lanes.x + V::set(Real(tile_x + 4 * (block & 3) + T::part_x(part)));
      const V y = lanes.y + V::set(Real(tile_y + 4 * (block >> 2) + T::part_y(part)));
      int count = 0;
      V low = V::set(Real(1e30)), high = zero;
      for (uint32_t e = P.lists.tile_begin[tile]; e < P.lists.tile_begin[tile + 1]; ++e) {
        if (!(P.lists.blocks[e] >> block & 1)) continue;
        const auto& record = static_cast<const typename Kind::Record*>(P.records)[P.lists.primitive[e]];
        typename Kind::Intersection intersection;
        const V v_length = V::load(length + at);
        const M hit = Kind::template intersect<false>(record, view, x - V::set(record.ref_x), y - V::set(record.ref_y),
                                                      v_length, intersection);
        if (!hit.bits()) continue;
        Kind::thickness(record, v_length, hit, intersection);
        V t_in, t_out;
        Kind::depths(record, v_length, intersection, t_in, t_out);
        t_in = select(hit, t_in, zero);
        const V thick = intersection.chord * rcp(v_length), rate = V::set(record.density) * v_length;
        low = min(low, select(hit, t_in, low)), high = max(high, t_in + thick);
        Real* slot = scratch + int64_t(count++) * 3 * W;
        t_in.store(slot), thick.store(slot + W), rate.store(slot + 2 * W);
      }
      auto thickness = [&](V t) {
        V sum = zero;
        for (int i = 0; i < count; ++i) {
          const Real* slot = scratch + int64_t(i) * 3 * W;
          sum = fma(V::load(slot + 2 * W), min(max(t - V::load(slot), zero), V::load(slot + W)), sum);
        }
        return sum;
      };
      const V total = thickness(high);
      V alpha, through;
      exp_neg(total, alpha, through);
      alpha.store(opacity + at);
      const M crosses = total >= wanted;
      for (int k = 0; k < kMostHalvings && (crosses & (resolution * high < high - low)).bits(); ++k) {
        const V middle = half * (low + high);
        const M behind = thickness(middle) >= wanted;
        high = select(behind, middle, high), low = select(behind, low, middle);
      }
      select(crosses, high, zero).store(depth + at);
    }
  T::store(view, tile_x, tile_y, depth, P.out.depth_median), T::store(view, tile_x, tile_y, opacity, P.out.opacity);
}

}  // namespace linprim::LINPRIM_ISA
