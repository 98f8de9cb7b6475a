// Common parts of the tile kernels: a tile's pixels in blocks of SIMD lanes, the mean depth inside a slice, sums over
// lanes.
//
// W lanes cover a part of a 4x4 block of pixels (all of it for W = 16). Per-pixel state is stored in arrays of 256,
// block by block.
#pragma once

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>

#include "raster/kernel_table.h"
#include "base/simd.h"

namespace linprim::LINPRIM_ISA {

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

template <class Real, int W>
struct Tile {
  using V = Vec<Real, W>;
  using M = Mask<Real, W>;
  using I = Index<Real, W>;
  static constexpr int kPartWidth = W < kBlock ? W : kBlock;
  static constexpr int kPartHeight = W / kPartWidth;
  static constexpr int kParts = kBlock * kBlock / W;

  // Position of part `part` in its block.
  static int part_x(int part) { return W < kBlock ? part % kBlock : 0; }
  static int part_y(int part) { return W < kBlock ? part / kBlock : part * kPartHeight; }

  // Computes the length of the ray (u, v, 1) through each pixel of the tile, in the order of the state arrays.
  static void ray_lengths(const View& view, int tile_x, int tile_y, Real* out) {
    alignas(64) Real uu[kTile], vv[kTile];
    const double fx = 1 / view.fx, fy = 1 / view.fy;
    for (int i = 0; i < kTile; ++i) {
      const double u = (tile_x + i + 0.5 - view.cx) * fx, v = (tile_y + i + 0.5 - view.cy) * fy;
      uu[i] = Real(1 + u * u), vv[i] = Real(v * v);
    }
    for (int i = 0; i < kTilePixels; i += kBlock)
      for (int x = 0; x < kBlock; ++x) out[i + x] = uu[4 * (i / 16 & 3) + x] + vv[4 * (i / 64) + i % 16 / 4];
    for (int i = 0; i < kTilePixels; i += W) sqrt(V::load(out + i)).store(out + i);
  }
  // Copies a tile's part of an image plane to the order of the state arrays, 0 outside the image (or everywhere without
  // a plane).
  static void load(const View& view, int tile_x, int tile_y, const Real* plane, Real* state) {
    if (!plane) {
      std::fill(state, state + kTilePixels, Real(0));
      return;
    }
    each_row_of_four(
        view, tile_x, tile_y,
        [&](int64_t at, int to, int count) {
          for (int x = 0; x < kBlock; ++x) state[to + x] = x < count ? plane[at + x] : Real(0);
        },
        [&](int64_t at, int to) { std::memcpy(state + to, plane + at, kBlock * sizeof(Real)); });
  }
  static void store(const View& view, int tile_x, int tile_y, const Real* state, Real* plane) {
    each_row_of_four(
        view, tile_x, tile_y,
        [&](int64_t at, int from, int count) {
          for (int x = 0; x < count; ++x) plane[at + x] = state[from + x];
        },
        [&](int64_t at, int from) { std::memcpy(plane + at, state + from, kBlock * sizeof(Real)); });
  }
  // Calls row(index into a plane, index into a state array, pixels inside the image, 0 to 4) for the 64 rows of the 16
  // blocks; if the whole tile is inside the image, calls whole(index into a plane, index into a state array).
  template <class Row, class Whole>
  static void each_row_of_four(const View& view, int tile_x, int tile_y, Row row, Whole whole) {
    const bool inside = tile_x + kTile <= view.width && tile_y + kTile <= view.height;
    for (int line = 0; line < kTile; ++line) {
      const int y = tile_y + line, first = line / 4 * 64 + line % 4 * 4;
      const int64_t at = int64_t(y) * view.width + tile_x;
      for (int b = 0; b < 4; ++b) {
        if (inside) {
          whole(at + 4 * b, first + 16 * b);
        } else {
          row(at + 4 * b, first + 16 * b, y < view.height ? std::clamp(view.width - tile_x - 4 * b, 0, kBlock) : 0);
        }
      }
    }
  }
  // Sets the transmittance to 1 for pixels of the image and to -1 for the others, which is never at or above `stop`, so
  // they are never hit. Returns the blocks that contain pixels of the image.
  static unsigned start(const View& view, int tile_x, int tile_y, Real* through) {
    unsigned alive = 0;
    each_row_of_four(
        view, tile_x, tile_y,
        [&](int64_t, int to, int count) {
          for (int x = 0; x < kBlock; ++x) through[to + x] = x < count ? Real(1) : Real(-1);
          if (count) alive |= 1u << (to / 16);
        },
        [&](int64_t, int to) {
          std::fill(through + to, through + to + kBlock, Real(1));
          alive = 0xffff;
        });
    return alive;
  }
};

// Mean position, relative to the slice, of the light absorbed in a slice of optical thickness tau, and its derivative:
// g = 1/tau - 1/(e^tau - 1), from 1/2 (thin) to 0 (opaque); a series below 0.3, where the difference would cancel.
template <class Real, int W>
inline void mean_in_slice(Vec<Real, W> tau, Vec<Real, W> alpha, Vec<Real, W> through, Vec<Real, W>& g,
                          Vec<Real, W>& slope) {
  using V = Vec<Real, W>;
  const V t2 = tau * tau;
  const Mask<Real, W> thin = tau < V::set(Real(0.3));
  // Next terms of the series: 691 tau^11 / 1.3e12 (g) and its derivative, below 1e-15 and 4e-14 at 0.3.
  auto series = [&](Real c0, Real c1, Real c2, Real c3, Real c4) {
    return fma(t2, fma(t2, fma(t2, fma(t2, V::set(c4), V::set(c3)), V::set(c2)), V::set(c1)), V::set(c0));
  };
  const V thin_g =
      fma(tau, series(Real(-1.0 / 12), Real(1.0 / 720), Real(-1.0 / 30240), Real(1.0 / 1209600), Real(-1.0 / 47900160)),
          V::set(Real(0.5)));
  const V thin_slope =
      series(Real(-1.0 / 12), Real(1.0 / 240), Real(-1.0 / 6048), Real(1.0 / 172800), Real(-1.0 / 5322240));
  const V safe = select(thin, V::set(1), tau), inverse = rcp(safe),
          over = through * rcp(select(thin, V::set(1), alpha));
  g = select(thin, thin_g, inverse - over);
  slope = select(thin, thin_slope,
                 fma(over * rcp(select(thin, V::set(1), alpha)), V::set(1), V::set(0) - inverse * inverse));
}

// Sums each of `count` accumulators over its lanes.
template <class Real, int W>
inline void reduce(const Vec<Real, W>* sums, int count, Real* out) {
  for (int i = 0; i < count; ++i) out[i] = sum(sums[i]);
}
#if defined(LINPRIM_ISA_V4)
// Sixteen accumulators at a time with a tree of half-adds: 45 instructions for 16 sums.
template <>
inline void reduce<float, 16>(const F16* a, int count, float* out) {
  for (int group = 0; group < count; group += 16, a += 16, out += 16) {
    __m512 z[4];
    for (int i = 0; i < 4; ++i) {
      const __m512 x =
          _mm512_add_ps(_mm512_shuffle_f32x4(a[i].v, a[i + 4].v, 0x44), _mm512_shuffle_f32x4(a[i].v, a[i + 4].v, 0xee));
      const __m512 y = _mm512_add_ps(_mm512_shuffle_f32x4(a[i + 8].v, a[i + 12].v, 0x44),
                                     _mm512_shuffle_f32x4(a[i + 8].v, a[i + 12].v, 0xee));
      z[i] = _mm512_add_ps(_mm512_shuffle_f32x4(x, y, 0x88), _mm512_shuffle_f32x4(x, y, 0xdd));
    }
    const __m512 u = _mm512_add_ps(_mm512_unpacklo_ps(z[0], z[1]), _mm512_unpackhi_ps(z[0], z[1]));
    const __m512 v = _mm512_add_ps(_mm512_unpacklo_ps(z[2], z[3]), _mm512_unpackhi_ps(z[2], z[3]));
    _mm512_storeu_ps(out, _mm512_add_ps(_mm512_shuffle_ps(u, v, 0x44), _mm512_shuffle_ps(u, v, 0xee)));
  }
}
#endif
#if defined(LINPRIM_ISA_V3)
// Eight accumulators at a time: horizontal adds inside the halves, then across the halves.
template <>
inline void reduce<float, 8>(const F8* a, int count, float* out) {
  for (int group = 0; group < count; group += 8, a += 8, out += 8) {
    const __m256 p = _mm256_hadd_ps(_mm256_hadd_ps(a[0].v, a[1].v), _mm256_hadd_ps(a[2].v, a[3].v));
    const __m256 q = _mm256_hadd_ps(_mm256_hadd_ps(a[4].v, a[5].v), _mm256_hadd_ps(a[6].v, a[7].v));
    _mm256_storeu_ps(out, _mm256_add_ps(_mm256_permute2f128_ps(p, q, 0x20), _mm256_permute2f128_ps(p, q, 0x31)));
  }
}
#endif

}  // namespace linprim::LINPRIM_ISA
