// The tile kernels: blend the primitives of one 16x16 tile in order, and the adjoint of that.
//
// W lanes cover a part of a 4x4 block of pixels (all of it for W = 16). Per-pixel state lives in arrays of 256, block after
// block. Included by kernels.cpp only.
#pragma once

#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>

#include "kernels.h"
#include "octahedron.h"
#include "simd.h"

namespace linprim::LINPRIM_ISA {

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

  // Length of the ray (u, v, 1) through each pixel of the tile, in the order of the state arrays.
  static void ray_lengths(const View& view, int tile_x, int tile_y, Real* out) {
    Real uu[kTile], vv[kTile];
    const double fx = 1 / view.fx, fy = 1 / view.fy;
    for (int i = 0; i < kTile; ++i) {
      const double u = (tile_x + i + 0.5 - view.cx) * fx, v = (tile_y + i + 0.5 - view.cy) * fy;
      uu[i] = Real(1 + u * u), vv[i] = Real(v * v);
    }
    for (int block = 0; block < kBlocks; ++block)
      for (int y = 0; y < kBlock; ++y)
        for (int x = 0; x < kBlock; ++x)
          out[16 * block + 4 * y + x] = std::sqrt(uu[4 * (block & 3) + x] + vv[4 * (block >> 2) + y]);
  }
  // A tile's part of an image plane into the order of the state arrays, 0 outside the image (and where there is no plane).
  static void load(const View& view, int tile_x, int tile_y, const Real* plane, Real* state) {
    if (!plane) {
      std::fill(state, state + kTilePixels, Real(0));
      return;
    }
    each_row_of_four(view, tile_x, tile_y, [&](int64_t at, int to, int count) {
      for (int x = 0; x < kBlock; ++x) state[to + x] = x < count ? plane[at + x] : Real(0);
    });
  }
  static void store(const View& view, int tile_x, int tile_y, const Real* state, Real* plane) {
    each_row_of_four(view, tile_x, tile_y, [&](int64_t at, int from, int count) {
      for (int x = 0; x < count; ++x) plane[at + x] = state[from + x];
    });
  }
  // Calls row(index into a plane, index into a state array, pixels inside the image, 0 to 4) for the 64 rows of the 16 blocks.
  template <class Row>
  static void each_row_of_four(const View& view, int tile_x, int tile_y, Row row) {
    const bool inside = tile_x + kTile <= view.width && tile_y + kTile <= view.height;
    for (int i = 0; i < kTilePixels; i += kBlock) {
      const int block = i / 16, x = tile_x + 4 * (block & 3), y = tile_y + 4 * (block >> 2) + i % 16 / 4;
      const int64_t at = int64_t(y) * view.width + x;
      if (inside) {
        row(at, i, kBlock);
      } else {
        row(at, i, y < view.height ? std::clamp(view.width - x, 0, kBlock) : 0);
      }
    }
  }
  // 1 for pixels of the image, -1 (a transmittance never at or above `stop`, so never hit) for the others; returns the blocks with any.
  static unsigned start(const View& view, int tile_x, int tile_y, Real* through) {
    unsigned alive = 0;
    each_row_of_four(view, tile_x, tile_y, [&](int64_t, int to, int count) {
      for (int x = 0; x < kBlock; ++x) through[to + x] = x < count ? Real(1) : Real(-1);
      if (count) alive |= 1u << (to / 16);
    });
    return alive;
  }
};

// Mean position, in units of the slice, of what is absorbed in a slice of optical thickness tau, and its derivative:
// g = 1/tau - 1/(e^tau - 1), from 1/2 (thin) to 0 (opaque); a series below 0.3, where the difference would cancel.
template <class Real, int W>
inline void mean_in_slice(Vec<Real, W> tau, Vec<Real, W> alpha, Vec<Real, W> through, Vec<Real, W>& g, Vec<Real, W>& slope) {
  using V = Vec<Real, W>;
  const V t2 = tau * tau;
  const Mask<Real, W> thin = tau < V::set(Real(0.3));
  // Next terms of the series: 691 tau^11 / 1.3e12 (g) and its derivative, below 1e-15 and 4e-14 at 0.3.
  auto series = [&](Real c0, Real c1, Real c2, Real c3, Real c4) {
    return fma(t2, fma(t2, fma(t2, fma(t2, V::set(c4), V::set(c3)), V::set(c2)), V::set(c1)), V::set(c0));
  };
  const V thin_g = fma(tau, series(Real(-1.0 / 12), Real(1.0 / 720), Real(-1.0 / 30240), Real(1.0 / 1209600), Real(-1.0 / 47900160)),
                       V::set(Real(0.5)));
  const V thin_slope = series(Real(-1.0 / 12), Real(1.0 / 240), Real(-1.0 / 6048), Real(1.0 / 172800), Real(-1.0 / 5322240));
  const V safe = select(thin, V::set(1), tau), inverse = rcp(safe), over = through * rcp(select(thin, V::set(1), alpha));
  g = select(thin, thin_g, inverse - over);
  slope = select(thin, thin_slope, fma(over * rcp(select(thin, V::set(1), alpha)), V::set(1), V::set(0) - inverse * inverse));
}

// Solid is the primitive kind and ray model, kOrder the order of blending, kGeometry the set of outputs: all that is off is not here.
template <class Solid, Order kOrder, bool kGeometry>
Counts forward_tile(const RasterParams<typename Solid::Real>& P, int tile) {
  static_assert(kOrder == Order::kCenter);  // tile lists come in the order of the centres
  using Real = typename Solid::Real;
  constexpr int W = Solid::kWidth;
  using T = Tile<Real, W>;
  using V = typename T::V;
  using M = typename T::M;
  using I = typename T::I;
  const View& view = P.view;
  const int tile_x = tile % P.tiles_x * kTile, tile_y = tile / P.tiles_x * kTile;
  const Lanes<Real, W> lanes;
  const Real stop = Real(view.stop), level = Real(view.level);
  const V zero = V::set(0), v_stop = V::set(stop), v_level = V::set(level);
  uint64_t visited_blocks = 0, hit_lanes = 0;

  alignas(64) Real length[kTilePixels], through[kTilePixels], red[kTilePixels], green[kTilePixels], blue[kTilePixels];
  constexpr int kStates = 13;  // first, reference, moment 1, moment 2, median, 1/(density |v|) there, normal 3, median normal 3, seen
  alignas(64) Real geo[kGeometry ? kStates : 1][kGeometry ? kTilePixels : 1];
  T::ray_lengths(view, tile_x, tile_y, length);
  unsigned alive = T::start(view, tile_x, tile_y, through);
  for (Real* channel : {red, green, blue}) std::fill(channel, channel + kTilePixels, Real(0));
  if constexpr (kGeometry)
    for (auto& plane : geo) std::fill(plane, plane + kTilePixels, Real(0));

  for (uint32_t e = P.tile_begin[tile]; e < P.tile_begin[tile + 1]; ++e) {
    Pair& pair = P.pairs[e];
    unsigned todo = pair.blocks & alive, touched = 0;
    if constexpr (kGeometry) P.pair_weight[pair.slot] = 0, P.pair_pixels[pair.slot] = 0;
    if (alive == 0) {
      pair.blocks = 0;
      if constexpr (kGeometry) continue;  // the statistics of the remaining pairs have to be cleared too
      for (; e < P.tile_begin[tile + 1]; ++e) P.pairs[e].blocks = 0;
      break;
    }
    if (todo == 0) {
      pair.blocks = 0;
      continue;
    }
    if (e + 2 < P.tile_begin[tile + 1]) {
      const char* next = reinterpret_cast<const char*>(&P.records[P.pairs[e + 2].primitive]);
      __builtin_prefetch(next), __builtin_prefetch(next + 64);
    }
    const Record<Real>& record = P.records[pair.primitive];
    Solid faces;
    faces.set(record, tile_x, tile_y, lanes, view);
    const V density = V::set(record.density), cr = V::set(record.rgb[0]), cg = V::set(record.rgb[1]), cb = V::set(record.rgb[2]);
    V largest = zero;
    uint32_t pixels = 0;
    while (todo) {
      const int block = std::countr_zero(todo);
      todo &= todo - 1;
      unsigned open = 0, hits = 0;
      for (int part = 0; part < T::kParts; ++part) {
        const int at = block * 16 + part * W;
        V in, out, t = V::load(through + at);
        I in_face, out_face;
        faces.template intersect<kGeometry>(Real(4 * (block & 3) + T::part_x(part)), Real(4 * (block >> 2) + T::part_y(part)), in, out,
                                            in_face, out_face);
        const M hit = (out < in) & (t >= v_stop);
        const unsigned bits = hit.bits();
        hits += unsigned(std::popcount(bits));
        if (bits) {
          const V w_in = in + faces.w0, w_out = out + faces.w0;
          const V inverse = rcp(w_in * w_out), v_length = V::load(length + at);
          const V tau = density * select(hit, v_length * (in - out) * inverse, zero);
          V alpha, e_tau;
          exp_neg(tau, alpha, e_tau);
          const V weight = select(hit, t * alpha, zero);  // t is -1 outside the image
          fma(weight, cr, V::load(red + at)).store(red + at);
          fma(weight, cg, V::load(green + at)).store(green + at);
          fma(weight, cb, V::load(blue + at)).store(blue + at);
          const V after = t * e_tau;
          if constexpr (kGeometry) {
            largest = max(largest, weight);
            pixels += unsigned(std::popcount(bits));
            const V t_in = w_out * inverse, t_out = w_in * inverse;
            V mean, slope;
            mean_in_slice(tau, alpha, e_tau, mean, slope);
            const V z = fma(t_out - t_in, mean, t_in);
            const M fresh = hit & (V::load(geo[12] + at) < V::set(Real(0.5)));
            select(fresh, V::set(1), V::load(geo[12] + at)).store(geo[12] + at);
            select(fresh, t_in, V::load(geo[0] + at)).store(geo[0] + at);
            const V origin = select(fresh, z, V::load(geo[1] + at));
            origin.store(geo[1] + at);
            const V dz = select(hit, z - origin, zero), wz = weight * dz;
            (V::load(geo[2] + at) + wz).store(geo[2] + at);
            fma(wz, dz, V::load(geo[3] + at)).store(geo[3] + at);
            const M crossing = hit & (v_level < t) & (v_level >= after);
            const M facing = hit & is_face(in_face);
            V normal[3] = {zero, zero, zero};
            for (int f = 0; f < 4; ++f) {
              const M here = facing & equal(in_face, f);
              for (int k = 0; k < 3; ++k) normal[k] = select(here, V::set(P.normals[pair.primitive][f][k]), normal[k]);
            }
            for (int k = 0; k < 3; ++k) fma(weight, normal[k], V::load(geo[6 + k] + at)).store(geo[6 + k] + at);
            if (crossing.bits()) {
              const V slowness = rcp(density * v_length);
              const V inside = log(select(crossing, t * V::set(1 / level), V::set(1))) * slowness;
              select(crossing, min(t_in + inside, t_out), V::load(geo[4] + at)).store(geo[4] + at);
              select(crossing, slowness, V::load(geo[5] + at)).store(geo[5] + at);
              for (int k = 0; k < 3; ++k) select(crossing, normal[k], V::load(geo[9 + k] + at)).store(geo[9 + k] + at);
            }
          }
          t = select(hit, after, t);
          t.store(through + at);
        }
        open |= (t >= v_stop).bits();
      }
      visited_blocks += 1;
      hit_lanes += hits;
      if (hits) touched |= 1u << block;
      if (!open) alive &= ~(1u << block);
    }
    pair.blocks = touched;
    if constexpr (kGeometry) P.pair_weight[pair.slot] = max_lane(largest), P.pair_pixels[pair.slot] = pixels;
  }

  const int64_t plane = int64_t(view.width) * view.height;
  auto store = [&](const Real* state, Real* to) { T::store(view, tile_x, tile_y, state, to); };
  const Real background[3] = {P.background[0], P.background[1], P.background[2]};
  for (int i = 0; i < kTilePixels; ++i) {
    red[i] += through[i] * background[0], green[i] += through[i] * background[1], blue[i] += through[i] * background[2];
    through[i] = 1 - through[i];
  }
  store(red, P.out.rgb), store(green, P.out.rgb + plane), store(blue, P.out.rgb + 2 * plane), store(through, P.out.opacity);
  if constexpr (kGeometry) {
    alignas(64) Real expected[kTilePixels], distortion[kTilePixels];
    for (int i = 0; i < kTilePixels; ++i) {
      expected[i] = geo[2][i] + geo[1][i] * through[i];
      distortion[i] = through[i] * geo[3][i] - geo[2][i] * geo[2][i];
    }
    store(geo[0], P.out.depth_first), store(expected, P.out.depth_expected), store(geo[4], P.out.depth_median);
    store(distortion, P.out.distortion);
    for (int k = 0; k < 3; ++k) store(geo[6 + k], P.out.normal + k * plane), store(geo[9 + k], P.out.normal_median + k * plane);
    store(geo[1], P.out.state), store(geo[2], P.out.state + plane), store(geo[3], P.out.state + 2 * plane);
    store(geo[5], P.out.state + 3 * plane);
  }
  return {visited_blocks * 16, hit_lanes};
}

// Sums of `count` accumulators over their lanes.
template <class Real, int W>
inline void reduce(const Vec<Real, W>* sums, int count, Real* out) {
  for (int i = 0; i < count; ++i) out[i] = sum(sums[i]);
}
#if defined(LINPRIM_ISA_V4)
// Sixteen accumulators at a time by a tree of half-adds: 45 instructions for 16 sums.
template <>
inline void reduce<float, 16>(const F16* a, int count, float* out) {
  for (int group = 0; group < count; group += 16, a += 16, out += 16) {
    __m512 z[4];
    for (int i = 0; i < 4; ++i) {
      const __m512 x = _mm512_add_ps(_mm512_shuffle_f32x4(a[i].v, a[i + 4].v, 0x44), _mm512_shuffle_f32x4(a[i].v, a[i + 4].v, 0xee));
      const __m512 y = _mm512_add_ps(_mm512_shuffle_f32x4(a[i + 8].v, a[i + 12].v, 0x44), _mm512_shuffle_f32x4(a[i + 8].v, a[i + 12].v, 0xee));
      z[i] = _mm512_add_ps(_mm512_shuffle_f32x4(x, y, 0x88), _mm512_shuffle_f32x4(x, y, 0xdd));
    }
    const __m512 u = _mm512_add_ps(_mm512_unpacklo_ps(z[0], z[1]), _mm512_unpackhi_ps(z[0], z[1]));
    const __m512 v = _mm512_add_ps(_mm512_unpacklo_ps(z[2], z[3]), _mm512_unpackhi_ps(z[2], z[3]));
    _mm512_storeu_ps(out, _mm512_add_ps(_mm512_shuffle_ps(u, v, 0x44), _mm512_shuffle_ps(u, v, 0xee)));
  }
}
#endif
#if defined(LINPRIM_ISA_V3)
// Eight accumulators at a time: horizontal adds inside the halves, then the halves.
template <>
inline void reduce<float, 8>(const F8* a, int count, float* out) {
  for (int group = 0; group < count; group += 8, a += 8, out += 8) {
    const __m256 p = _mm256_hadd_ps(_mm256_hadd_ps(a[0].v, a[1].v), _mm256_hadd_ps(a[2].v, a[3].v));
    const __m256 q = _mm256_hadd_ps(_mm256_hadd_ps(a[4].v, a[5].v), _mm256_hadd_ps(a[6].v, a[7].v));
    _mm256_storeu_ps(out, _mm256_add_ps(_mm256_permute2f128_ps(p, q, 0x20), _mm256_permute2f128_ps(p, q, 0x31)));
  }
}
#endif

template <class Solid, Order kOrder, bool kGeometry>
void backward_tile(const RasterParams<typename Solid::Real>& P, int tile) {
  static_assert(kOrder == Order::kCenter);
  using Real = typename Solid::Real;
  constexpr int W = Solid::kWidth;
  using T = Tile<Real, W>;
  using V = typename T::V;
  using M = typename T::M;
  using I = typename T::I;
  const View& view = P.view;
  const int tile_x = tile % P.tiles_x * kTile, tile_y = tile / P.tiles_x * kTile;
  const Lanes<Real, W> lanes;
  const V zero = V::set(0), v_stop = V::set(Real(view.stop)), v_level = V::set(Real(view.level));
  constexpr int kSums = kGeometry ? kGeometrySums : kColorSums;

  // remaining = sum over what is still in front of us (background included) of its weight times (its value . gradient).
  alignas(64) Real length[kTilePixels], through[kTilePixels], remaining[kTilePixels], g_red[kTilePixels], g_green[kTilePixels],
      g_blue[kTilePixels], g_one[kTilePixels];
  // gradient to moment 1, moment 2, first depth, median depth, normal 3, median normal 3; reference depth; 1/(density |v|); seen
  constexpr int kStates = 13;
  alignas(64) Real geo[kGeometry ? kStates : 1][kGeometry ? kTilePixels : 1];
  T::ray_lengths(view, tile_x, tile_y, length);
  const int64_t plane = int64_t(view.width) * view.height;
  T::start(view, tile_x, tile_y, through);
  auto load = [&](const Real* from, int channel, Real* state) {
    T::load(view, tile_x, tile_y, from ? from + channel * plane : nullptr, state);
  };
  alignas(64) Real opacity[kTilePixels], value[3][kTilePixels];
  load(P.out.opacity, 0, opacity);
  for (int k = 0; k < 3; ++k) load(P.out.rgb, k, value[k]);
  load(P.grad.rgb, 0, g_red), load(P.grad.rgb, 1, g_green), load(P.grad.rgb, 2, g_blue), load(P.grad.opacity, 0, g_one);
  for (int i = 0; i < kTilePixels; ++i) remaining[i] = g_red[i] * value[0][i] + g_green[i] * value[1][i] + g_blue[i] * value[2][i];
  Real background_sum[3] = {0, 0, 0};
  for (int i = 0; i < kTilePixels; ++i) {
    const Real t = 1 - opacity[i];  // outside the image this is 1, but the gradients there are 0
    background_sum[0] += t * g_red[i], background_sum[1] += t * g_green[i], background_sum[2] += t * g_blue[i];
  }
  if constexpr (kGeometry) {
    alignas(64) Real m1[kTilePixels], m2[kTilePixels], g_distortion[kTilePixels], normal[3][kTilePixels];
    load(P.out.state, 0, geo[10]), load(P.out.state, 1, m1), load(P.out.state, 2, m2), load(P.out.state, 3, geo[11]);
    load(P.grad.depth_expected, 0, geo[0]), load(P.grad.distortion, 0, g_distortion);
    load(P.grad.depth_first, 0, geo[2]), load(P.grad.depth_median, 0, geo[3]);
    for (int k = 0; k < 3; ++k) load(P.grad.normal, k, geo[4 + k]), load(P.grad.normal_median, k, geo[7 + k]), load(P.out.normal, k, normal[k]);
    std::fill(geo[12], geo[12] + kTilePixels, Real(0));
    for (int i = 0; i < kTilePixels; ++i) {
      g_one[i] += geo[0][i] * geo[10][i] + g_distortion[i] * m2[i];
      geo[0][i] -= 2 * m1[i] * g_distortion[i];
      geo[1][i] = g_distortion[i] * opacity[i];
      remaining[i] += geo[0][i] * m1[i] + geo[1][i] * m2[i] + geo[4][i] * normal[0][i] + geo[5][i] * normal[1][i] + geo[6][i] * normal[2][i];
    }
  }
  for (int i = 0; i < kTilePixels; ++i) remaining[i] += g_one[i] * opacity[i];
  for (int k = 0; k < 3; ++k) P.background_sums[3 * tile + k] = background_sum[k];

  for (uint32_t e = P.tile_begin[tile]; e < P.tile_begin[tile + 1]; ++e) {
    const Pair& pair = P.pairs[e];
    Real* slot = P.sums + int64_t(pair.slot) * kSums;
    unsigned todo = pair.blocks;
    if (todo == 0) {
      std::fill(slot, slot + kSums, Real(0));
      continue;
    }
    if (e + 2 < P.tile_begin[tile + 1]) {
      const char* next = reinterpret_cast<const char*>(&P.records[P.pairs[e + 2].primitive]);
      __builtin_prefetch(next), __builtin_prefetch(next + 64), __builtin_prefetch(next + 128), __builtin_prefetch(next + 192);
    }
    const Record<Real>& record = P.records[pair.primitive];
    Solid faces;
    faces.set(record, tile_x, tile_y, lanes, view);
    const V density = V::set(record.density), cr = V::set(record.rgb[0]), cg = V::set(record.rgb[1]), cb = V::set(record.rgb[2]);
    V sums[kSums];
    for (V& s : sums) s = zero;
    while (todo) {
      const int block = std::countr_zero(todo);
      todo &= todo - 1;
      for (int part = 0; part < T::kParts; ++part) {
        const int at = block * 16 + part * W;
        const int x = 4 * (block & 3) + T::part_x(part), y = 4 * (block >> 2) + T::part_y(part);
        V in, out;
        const V t = V::load(through + at);
        I in_face, out_face;
        faces.template intersect<true>(Real(x), Real(y), in, out, in_face, out_face);
        const M hit = (out < in) & (t >= v_stop);
        if (T::kParts > 1 && !hit.bits()) continue;
        const V w_in = in + faces.w0, w_out = out + faces.w0;
        const V inverse = rcp(w_in * w_out), v_length = V::load(length + at);
        const V chord = select(hit, v_length * (in - out) * inverse, zero), tau = density * chord;
        V alpha, e_tau;
        exp_neg(tau, alpha, e_tau);
        const V after = t * e_tau, weight = select(hit, t * alpha, zero);
        const V gr = V::load(g_red + at), gg = V::load(g_green + at), gb = V::load(g_blue + at);
        V value = fma(cr, gr, fma(cg, gg, fma(cb, gb, V::load(g_one + at))));
        const V t_in = w_out * inverse, t_out = w_in * inverse;
        V d_in = zero, d_out = zero, d_tau_direct = zero, d_density_direct = zero;  // gradients to t_in, t_out, tau, density
        if constexpr (kGeometry) {
          V mean, slope;
          mean_in_slice(tau, alpha, e_tau, mean, slope);
          const V thick = t_out - t_in;
          const V dz = select(hit, fma(thick, mean, t_in) - V::load(geo[10] + at), zero);
          const V g1 = V::load(geo[0] + at), g2 = V::load(geo[1] + at);
          value = value + dz * fma(dz, g2, g1);
          const V g_z = weight * fma(dz + dz, g2, g1);
          d_in = g_z * (V::set(1) - mean), d_out = g_z * mean, d_tau_direct = g_z * thick * slope;

          const M fresh = hit & (V::load(geo[12] + at) < V::set(Real(0.5)));
          select(fresh, V::set(1), V::load(geo[12] + at)).store(geo[12] + at);
          d_in = d_in + select(fresh, V::load(geo[2] + at), zero);

          const V g_median = V::load(geo[3] + at), slowness = V::load(geo[11] + at);
          const M crossing = hit & (v_level < t) & (v_level >= after), before = hit & (v_level < after);
          d_in = d_in + select(crossing, g_median, zero);
          d_tau_direct = d_tau_direct - select(before, g_median * slowness, zero);
          if (crossing.bits()) {
            const V inside = log(select(crossing, t * V::set(Real(1 / view.level)), V::set(1))) * slowness;
            d_density_direct = zero - select(crossing, g_median * inside * rcp(density), zero);
          }
          for (int f = 0; f < 4; ++f) {
            const M here = hit & equal(in_face, f);
            if (!here.bits()) continue;
            const M median_here = here & crossing;
            for (int k = 0; k < 3; ++k) {
              const V g_normal = V::load(geo[4 + k] + at);
              value = fma(select(here, V::set(P.normals[pair.primitive][f][k]), zero), g_normal, value);
              V& s = sums[Sum::normal + 3 * f + k];
              s = fma(select(here, weight, zero), g_normal, s);
              s = s + select(median_here, V::load(geo[7 + k] + at), zero);
            }
          }
        }
        const V rest = V::load(remaining + at) - weight * value;
        const V d_tau = select(hit, fma(after, value, d_tau_direct - rest), zero);
        sums[Sum::rgb] = fma(weight, gr, sums[Sum::rgb]);
        sums[Sum::rgb + 1] = fma(weight, gg, sums[Sum::rgb + 1]);
        sums[Sum::rgb + 2] = fma(weight, gb, sums[Sum::rgb + 2]);
        sums[Sum::density] = fma(d_tau, chord, sums[Sum::density] + d_density_direct);
        const V d_chord = d_tau * density * v_length;
        // chord = |v| (t_out - t_in); w = 1/t, so dL/dw = -t^2 dL/dt. A ray that entered through the near plane moves with no face.
        const V g_in = select(hit & is_face(in_face), t_in * t_in * (d_chord - d_in), zero);
        const V g_out = select(hit & is_face(out_face), zero - t_out * t_out * (d_chord + d_out), zero);
        // A lane that does not hit may hold an infinity, and 0 times that is no number.
        const V g_in_w = g_in * select(hit, in, zero), g_out_w = g_out * select(hit, out, zero);
        const V px = lanes.x + V::set(Real(x)), py = lanes.y + V::set(Real(y));
        faces.add_gradient(record, in_face, out_face, g_in, g_out, g_in_w, g_out_w, px, py, sums);
        rest.store(remaining + at);
        select(hit, after, t).store(through + at);
      }
    }
    reduce(sums, kSums, slot);
    Solid::recenter(record, tile_x, tile_y, slot);
  }
}

// Where the transmittance of one tile's rays falls to `level`, all primitives absorbing where they are, overlaps included:
// sum_i density_i |v| clamp(t - t_in_i, 0, t_out_i - t_in_i) = ln(1 / level). The sum does not depend on any order and grows with t,
// so it is bisected. `scratch` holds 3 * 16 values per pair of the longest tile list. Writes out.depth_median, 0 where never, and
// out.opacity, which does not depend on the order either.
template <class Solid>
void level_depth_tile(const RasterParams<typename Solid::Real>& P, int tile, typename Solid::Real* scratch) {
  using Real = typename Solid::Real;
  constexpr int W = Solid::kWidth;
  using T = Tile<Real, W>;
  using V = typename T::V;
  using M = typename T::M;
  using I = typename T::I;
  constexpr int kMostHalvings = sizeof(Real) == 4 ? 80 : 140;  // enough from any bracket; far fewer are the rule
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
      int count = 0;
      V low = V::set(Real(1e30)), high = zero;
      for (uint32_t e = P.tile_begin[tile]; e < P.tile_begin[tile + 1]; ++e) {
        if (!(P.pairs[e].blocks >> block & 1)) continue;
        const Record<Real>& record = P.records[P.pairs[e].primitive];
        Solid faces;
        faces.set(record, tile_x, tile_y, lanes, view);
        V in, out;
        I in_face, out_face;
        faces.template intersect<false>(Real(4 * (block & 3) + T::part_x(part)), Real(4 * (block >> 2) + T::part_y(part)), in, out, in_face,
                                        out_face);
        const M hit = out < in;
        if (!hit.bits()) continue;
        const V w_in = in + faces.w0, w_out = out + faces.w0, inverse = rcp(w_in * w_out);
        const V t_in = select(hit, w_out * inverse, zero);
        const V thick = select(hit, (in - out) * inverse, zero), rate = V::set(record.density) * V::load(length + at);
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
