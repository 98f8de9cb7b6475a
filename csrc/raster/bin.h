// Binning: which 4x4 pixel blocks of which tiles a primitive's silhouette touches. Included by kernels.cpp only.
#pragma once

#include <algorithm>

#include "raster/kernel_table.h"
#include "base/simd.h"

namespace linprim::LINPRIM_ISA {

template <int W>
int64_t bin(const BinParams& P, int64_t begin, int64_t end, LoosePair* out, int64_t capacity, int64_t* written) {
  using V = Vec<float, W>;
  constexpr int kParts = kBlocks / W, kSide = kTile / kBlock;
  alignas(64) float block_x[kBlocks], block_y[kBlocks];
  for (int i = 0; i < kBlocks; ++i) block_x[i] = float(kBlock * (i % kSide)), block_y[i] = float(kBlock * (i / kSide));
  const V zero = V::set(0), step = V::set(float(kTile));
  const Footprint* const footprints = P.footprints;
  const uint32_t* const visible = P.visible;
  uint32_t *const slot_count = P.slot_count, *const tile_count = P.tile_count;
  const int tiles_x = P.tiles_x;
  int64_t count = 0, i = begin;
  for (; i < end; ++i) {
    const Footprint& f = footprints[visible[i]];
    // The box in blocks and in tiles; visible primitives have no negative corner.
    const int bx0 = int(uint32_t(f.x0) / kBlock), bx1 = int(uint32_t(f.x1) / kBlock);
    const int by0 = int(uint32_t(f.y0) / kBlock), by1 = int(uint32_t(f.y1) / kBlock);
    const int tx0 = bx0 / kSide, tx1 = bx1 / kSide, ty0 = by0 / kSide, ty1 = by1 / kSide;
    if (count + int64_t(tx1 - tx0 + 1) * (ty1 - ty0 + 1) > capacity) break;
    const int64_t first = count;
    V first_x[kParts];
    for (int p = 0; p < kParts; ++p) first_x[p] = V::load(block_x + p * W) + V::set(float(tx0 * kTile - f.ref_x));
    for (int ty = ty0; ty <= ty1; ++ty) {
      const int r0 = std::max(by0 - ty * kSide, 0), r1 = std::min(by1 - ty * kSide, kSide - 1);
      const unsigned rows = (0xffffu << (4 * r0)) & (0xffffu >> (12 - 4 * r1));
      V x[kParts], line[6][kParts];  // x and the part of each line that the tiles of a row share
      for (int p = 0; p < kParts; ++p) {
        const V y = V::load(block_y + p * W) + V::set(float(ty * kTile - f.ref_y));
        x[p] = first_x[p];
        for (int e = 0; e < 6; ++e) line[e][p] = fma(V::set(f.c[e]), y, V::set(f.a[e]));
      }
      uint32_t tile = uint32_t(ty * tiles_x + tx0);
      for (int c0 = bx0 - tx0 * kSide, c1 = bx1 - tx0 * kSide; c1 >= 0; c0 -= kSide, c1 -= kSide, ++tile) {
        const unsigned columns =
            ((0xfu << std::max(c0, 0)) & (0xfu >> (kSide - 1 - std::min(c1, kSide - 1)))) * 0x1111u;
        unsigned blocks = 0;
        for (int p = 0; p < kParts; ++p) {
          auto holds = [&](int e) { return zero < fma(V::set(f.b[e]), x[p], line[e][p]); };
          auto all = holds(0);
#pragma GCC unroll 8
          for (int e = 1; e < 6; ++e) all = all & holds(e);
          blocks |= all.bits() << (p * W);
          x[p] = x[p] + step;
        }
        blocks &= rows & columns;
        out[count] = {tile, blocks};
        count += blocks != 0, tile_count[tile] += blocks != 0;
      }
    }
    slot_count[visible[i]] = uint32_t(count - first);
  }
  *written = count;
  return i;
}

}  // namespace linprim::LINPRIM_ISA
