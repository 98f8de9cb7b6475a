// Which 4x4 blocks of which tiles a primitive's silhouette touches. Included by kernels.cpp only.
#pragma once

#include <algorithm>

#include "kernels.h"
#include "simd.h"

namespace linprim::LINPRIM_ISA {

// How far ahead of its use, in primitives, a footprint is fetched: they are visited in the order of depth, not of memory.
constexpr int64_t kFetchAhead = 8;

template <int W>
int64_t bin(const BinParams& P, int64_t begin, int64_t end, LoosePair* out, int64_t capacity, int64_t* written) {
  using V = Vec<float, W>;
  constexpr int kParts = kBlocks / W;
  alignas(64) float lx[kBlocks], ly[kBlocks];
  for (int i = 0; i < kBlocks; ++i) lx[i] = float(kBlock * (i & 3)), ly[i] = float(kBlock * (i >> 2));
  const V zero = V::set(0);
  int64_t count = 0, i = begin;
  for (; i < end; ++i) {
    const uint32_t primitive = P.order[i];
    if (i + kFetchAhead < end) {
      const char* next = reinterpret_cast<const char*>(&P.footprints[P.order[i + kFetchAhead]]);
      __builtin_prefetch(next), __builtin_prefetch(next + 64);
    }
    const Footprint& f = P.footprints[primitive];
    const int tx0 = f.x0 / kTile, tx1 = f.x1 / kTile, ty0 = f.y0 / kTile, ty1 = f.y1 / kTile;
    if (count + int64_t(tx1 - tx0 + 1) * (ty1 - ty0 + 1) > capacity) break;
    V slope[6][kParts];
    for (int e = 0; e < 6; ++e)
      for (int p = 0; p < kParts; ++p) slope[e][p] = fma(V::set(f.b[e]), V::load(lx + p * W), V::set(f.c[e]) * V::load(ly + p * W));
    for (int ty = ty0; ty <= ty1; ++ty) {
      const int r0 = std::max(f.y0 - ty * kTile, 0) / kBlock, r1 = std::min(f.y1 - ty * kTile, kTile - 1) / kBlock;
      const unsigned rows = (0xffffu << (4 * r0)) & (0xffffu >> (12 - 4 * r1));
      const float dy = float(ty * kTile - f.ref_y);
      for (int tx = tx0; tx <= tx1; ++tx) {
        const int c0 = std::max(f.x0 - tx * kTile, 0) / kBlock, c1 = std::min(f.x1 - tx * kTile, kTile - 1) / kBlock;
        unsigned blocks = rows & (((0xfu << c0) & (0xfu >> (3 - c1))) * 0x1111u);
        const float dx = float(tx * kTile - f.ref_x);
        unsigned inside = 0;
        for (int p = 0; p < kParts; ++p) {
          auto holds = [&](int e) { return zero < V::set(f.a[e] + f.b[e] * dx + f.c[e] * dy) + slope[e][p]; };
          auto all = holds(0);
          for (int e = 1; e < 6; ++e) all = all & holds(e);
          inside |= all.bits() << (p * W);
        }
        blocks &= inside;
        if (blocks) out[count++] = {uint32_t(ty * P.tiles_x + tx), primitive, blocks};
      }
    }
  }
  *written = count;
  return i;
}

}  // namespace linprim::LINPRIM_ISA
