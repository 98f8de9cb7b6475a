// Measures the current speed of one core: peak multiply-adds, the vector exponential, and the bare work per (primitive,
// tile) pair with all data in cache and every pixel hit. The rasterizer's speed is reported as a ratio to these
// (tools/bench.py).
#pragma once

#include <chrono>

#include "raster/blend_center.h"
#include "primitives/octahedron.h"

namespace linprim::LINPRIM_ISA {

// Returns the shortest of `repeats` timings of `work`, in nanoseconds.
template <class Work>
inline double shortest_ns(int repeats, Work work) {
  double best = 1e30;
  for (int r = 0; r < repeats; ++r) {
    const auto begin = std::chrono::steady_clock::now();
    work();
    best = std::min(best, std::chrono::duration<double, std::nano>(std::chrono::steady_clock::now() - begin).count());
  }
  return best;
}

template <int W>
Limits measure_limits() {
  using V = Vec<float, W>;
  using Kind = Octahedron<float, W, RayModel::kExact>;
  using T = Tile<float, W>;
  constexpr int kRepeats = 15;
  Limits limits{};

  {
    constexpr int kChains = 12, kSteps = 4000;  // latency times throughput is 8 to 10
    V sums[kChains], factor = V::set(0.999f), step = V::set(1e-3f);
    for (V& s : sums) s = V::set(1);
    asm("" : "+m"(factor), "+m"(step));
    const double ns = shortest_ns(kRepeats, [&] {
      for (int i = 0; i < kSteps; ++i)
#pragma GCC unroll 12
        for (V& s : sums) s = fma(s, factor, step);
      asm volatile("" : "+m"(sums));
    });
    limits.fma_gflops = 2.0 * kChains * kSteps * W / ns;
  }
  {
    constexpr int kValues = 2048;
    alignas(64) float in[kValues], alpha[kValues], through[kValues];
    for (int i = 0; i < kValues; ++i) in[i] = 0.01f * float(i % 700);
    const double ns = shortest_ns(kRepeats, [&] {
      for (int i = 0; i < kValues; i += W) {
        V a, t;
        exp_neg(V::load(in + i), a, t);
        a.store(alpha + i), t.store(through + i);
      }
      asm volatile("" : : "m"(alpha), "m"(through));
    });
    limits.exp_ns = ns / kValues;
  }

  // Octahedra in front of a camera with a focal length of 600 pixels. Each covers the whole tile, and all are so thin
  // that no ray ends.
  constexpr int kPairs = 32;
  View view{};
  view.fx = view.fy = 600, view.cx = view.cy = 8, view.width = view.height = kTile, view.near = 0.01, view.stop = 1e-3,
  view.level = 0.5;
  for (int i = 0; i < 3; ++i) view.world_to_camera[5 * i] = 1;
  float center[kPairs][3], rotation[kPairs][4], extent[kPairs][3], density[kPairs], sh[kPairs][3], color[kPairs][3],
      key[kPairs];
  Footprint footprints[kPairs];
  OctahedronRecord<float> records[kPairs];
  for (int i = 0; i < kPairs; ++i) {
    const float part = float(i) / kPairs;
    center[i][0] = center[i][1] = 0, center[i][2] = 4 + part;
    rotation[i][0] = 1, rotation[i][1] = 0.3f * part, rotation[i][2] = 0.2f, rotation[i][3] = 0.1f;
    for (int k = 0; k < 3; ++k) extent[i][k] = 0.4f + 0.1f * float(k), sh[i][k] = 0.5f;
    density[i] = 0.02f;
  }
  const Primitives<float> primitives{
      PrimitiveKind::kOctahedron, kPairs, center[0], rotation[0], extent[0], density, sh[0], 1};
  project_octahedra<float, RayModel::kExact>({view, primitives, records, footprints, key, color[0], nullptr}, 0,
                                             kPairs);

  const Lanes<float, W> lanes;
  alignas(64) float length[kTilePixels], through[kTilePixels], red[kTilePixels], green[kTilePixels], blue[kTilePixels];
  T::ray_lengths(view, 0, 0, length);
  auto each_part = [&](auto body) {
    for (int block = 0; block < kBlocks; ++block)
      for (int part = 0; part < T::kParts; ++part)
        body(block * 16 + part * W, lanes.x + V::set(float(4 * (block & 3) + T::part_x(part))),
             lanes.y + V::set(float(4 * (block >> 2) + T::part_y(part))));
  };
  const double forward = shortest_ns(kRepeats, [&] {
    each_part([&](int at, V x, V y) {
      const V v_length = V::load(length + at);
      V t = V::set(1), r = V::set(0), g = r, b = r;
      for (int first = 0; first < kPairs; first += kGroup) {
        V taus[kGroup];
        for (int i = 0; i < kGroup; ++i) {
          const auto& R = records[first + i];
          typename Kind::Intersection m;
          const auto hit =
              Kind::template intersect<false>(R, view, x - V::set(R.ref_x), y - V::set(R.ref_y), v_length, m);
          taus[i] = Kind::thickness(R, v_length, hit, m);
        }
        for (int i = 0; i < kGroup; ++i) {
          const auto& R = records[first + i];
          V alpha, e_tau;
          Kind::attenuate(R, taus[i], alpha, e_tau);
          const V weight = t * alpha;
          r = fma(weight, V::set(R.rgb[0]), r), g = fma(weight, V::set(R.rgb[1]), g),
          b = fma(weight, V::set(R.rgb[2]), b);
          t = t * e_tau;
        }
      }
      t.store(through + at), r.store(red + at), g.store(green + at), b.store(blue + at);
    });
    asm volatile("" : : "m"(through), "m"(red), "m"(green), "m"(blue));
  });
  limits.pair_forward_ns = forward / (kPairs * kTilePixels);

  Incoming<float, W, false> state;
  std::copy(length, length + kTilePixels, state.length);
  for (float* plane : {state.red, state.green, state.blue, state.one}) std::fill(plane, plane + kTilePixels, 0.1f);
  float slots[kPairs][Kind::kColorSums];
  const double backward = shortest_ns(kRepeats, [&] {
    std::fill(state.through, state.through + kTilePixels, 1.0f);
    std::fill(state.remaining, state.remaining + kTilePixels, 0.2f);
    for (int i = 0; i < kPairs; ++i) {
      const auto& record_of_pair = records[i];
      V sums[Kind::kColorSums];
      for (V& s : sums) s = V::set(0);
      each_part([&](int at, V x, V y) {
        const auto& R = opaque(record_of_pair);
        typename Kind::Intersection m;
        const V v_length = V::load(state.length + at);
        const auto hit = Kind::template intersect<true>(R, view, x - V::set(R.ref_x), y - V::set(R.ref_y), v_length, m);
        const V tau = Kind::thickness(R, v_length, hit, m);
        blend_backward<Kind, false>(R, nullptr, view, state, m, hit, tau, at, x, y, sums);
      });
      reduce(sums, Kind::kColorSums, slots[i]);
    }
    asm volatile("" : : "m"(slots));
  });
  limits.pair_backward_ns = backward / (kPairs * kTilePixels);
  return limits;
}

}  // namespace linprim::LINPRIM_ISA
