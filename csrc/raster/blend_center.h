// Blending primitives one after another in the order of their tile's list, and its backward pass.
//
// The forward pass processes a tile block by block, so that a block's pixels stay in registers; the backward pass
// processes it primitive by primitive, so that a primitive's gradient sums stay in registers. Both intersect several
// entries before they blend them: each half of an entry is a long chain of dependent instructions, and in separate
// loops the processor can overlap several of each.
#pragma once

#include "raster/tile.h"

namespace linprim::LINPRIM_ISA {

constexpr int kChunk = 32;  // pairs of a list that are processed together, one bit each
constexpr int kGroup = 8;   // entries that are intersected before they are blended

// Per-pixel state of the geometry outputs in the forward pass of a tile.
enum GeometryState {
  kFirst,
  kReference,
  kMoment1,
  kMoment2,
  kMedian,
  kSlowness,
  kNormal,
  kMedianNormal = kNormal + 3,
  kSeen = kMedianNormal + 3,
  kGeometryStates
};

// Adds one primitive to the geometry outputs of a part of a block.
template <class Kind>
inline void blend_geometry(const typename Kind::Record& record, const typename Kind::Real (*normals)[3],
                           Vec<typename Kind::Real, Kind::kWidth> v_length, Mask<typename Kind::Real, Kind::kWidth> hit,
                           Index<typename Kind::Real, Kind::kWidth> in_face, Vec<typename Kind::Real, Kind::kWidth> t,
                           Vec<typename Kind::Real, Kind::kWidth> after, Vec<typename Kind::Real, Kind::kWidth> tau,
                           Vec<typename Kind::Real, Kind::kWidth> alpha, Vec<typename Kind::Real, Kind::kWidth> e_tau,
                           Vec<typename Kind::Real, Kind::kWidth> weight, Vec<typename Kind::Real, Kind::kWidth> t_in,
                           Vec<typename Kind::Real, Kind::kWidth> t_out, typename Kind::Real level,
                           typename Kind::Real (*geo)[kTilePixels], int at) {
  using Real = typename Kind::Real;
  using V = Vec<Real, Kind::kWidth>;
  using M = Mask<Real, Kind::kWidth>;
  const V zero = V::set(0), v_level = V::set(level);
  auto state = [&](int s) { return V::load(geo[s] + at); };
  V z = t_in;
  if constexpr (Kind::kVolume) {
    V mean, slope;
    mean_in_slice(tau, alpha, e_tau, mean, slope);
    z = fma(t_out - t_in, mean, t_in);
  }
  const M fresh = hit & (state(kSeen) < V::set(Real(0.5)));
  select(fresh, V::set(1), state(kSeen)).store(geo[kSeen] + at);
  select(fresh, t_in, state(kFirst)).store(geo[kFirst] + at);
  const V origin = select(fresh, z, state(kReference));
  origin.store(geo[kReference] + at);
  const V dz = select(hit, z - origin, zero), wz = weight * dz;
  (state(kMoment1) + wz).store(geo[kMoment1] + at);
  fma(wz, dz, state(kMoment2)).store(geo[kMoment2] + at);
  const M crossing = hit & (v_level < t) & (v_level >= after);
  V normal[3] = {zero, zero, zero};
  for (int f = 0; f < 4; ++f) {
    const M here = hit & equal(in_face, f);
    for (int k = 0; k < 3; ++k) normal[k] = select(here, V::set(normals[f][k]), normal[k]);
  }
  for (int k = 0; k < 3; ++k) fma(weight, normal[k], state(kNormal + k)).store(geo[kNormal + k] + at);
  if (crossing.bits()) {
    V median = t_in;
    if constexpr (Kind::kVolume) {
      const V slowness = rcp(V::set(record.density) * v_length);
      const V inside = log(select(crossing, t * V::set(1 / level), V::set(1))) * slowness;
      median = min(t_in + inside, t_out);
      select(crossing, slowness, state(kSlowness)).store(geo[kSlowness] + at);
    }
    select(crossing, median, state(kMedian)).store(geo[kMedian] + at);
    for (int k = 0; k < 3; ++k)
      select(crossing, normal[k], state(kMedianNormal + k)).store(geo[kMedianNormal + k] + at);
  }
}

// Writes a tile's finished pixels to the image planes. Colours come without the background; `through` is the remaining
// transmittance.
template <class Real, int W, bool kGeometry>
inline void store_pixels(const RasterParams<Real>& P, int tile_x, int tile_y, Real* red, Real* green, Real* blue,
                         Real* through, Real (*geo)[kTilePixels]) {
  using T = Tile<Real, W>;
  const View& view = P.view;
  const int64_t plane = int64_t(view.width) * view.height;
  auto store = [&](const Real* state, Real* to) { T::store(view, tile_x, tile_y, state, to); };
  const Real background[3] = {P.background[0], P.background[1], P.background[2]};
  for (int i = 0; i < kTilePixels; ++i) {
    red[i] += through[i] * background[0], green[i] += through[i] * background[1], blue[i] += through[i] * background[2];
    through[i] = 1 - through[i];
  }
  store(red, P.out.rgb), store(green, P.out.rgb + plane), store(blue, P.out.rgb + 2 * plane),
      store(through, P.out.opacity);
  if constexpr (kGeometry) {
    alignas(64) Real expected[kTilePixels], distortion[kTilePixels];
    for (int i = 0; i < kTilePixels; ++i) {
      expected[i] = geo[kMoment1][i] + geo[kReference][i] * through[i];
      distortion[i] = through[i] * geo[kMoment2][i] - geo[kMoment1][i] * geo[kMoment1][i];
    }
    store(geo[kFirst], P.out.depth_first), store(expected, P.out.depth_expected),
        store(geo[kMedian], P.out.depth_median);
    store(distortion, P.out.distortion);
    for (int k = 0; k < 3; ++k)
      store(geo[kNormal + k], P.out.normal + k * plane), store(geo[kMedianNormal + k], P.out.normal_median + k * plane);
    store(geo[kReference], P.out.state), store(geo[kMoment1], P.out.state + plane),
        store(geo[kMoment2], P.out.state + 2 * plane);
    store(geo[kSlowness], P.out.state + 3 * plane);
  }
}

template <class Kind, bool kGeometry>
Counts forward_center(const RasterParams<typename Kind::Real>& P, int tile, void*) {
  using Real = typename Kind::Real;
  constexpr int W = Kind::kWidth;
  using T = Tile<Real, W>;
  using V = typename T::V;
  using M = typename T::M;
  using I = typename T::I;
  const View& view = P.view;
  const int tile_x = tile % P.tiles_x * kTile, tile_y = tile / P.tiles_x * kTile;
  const Lanes<Real, W> lanes;
  const V zero = V::set(0), v_stop = V::set(Real(view.stop));
  const auto* records = static_cast<const typename Kind::Record*>(P.records);
  uint64_t visited = 0, hit_lanes = 0;

  alignas(64) Real length[kTilePixels], through[kTilePixels], red[kTilePixels], green[kTilePixels], blue[kTilePixels];
  alignas(64) Real geo[kGeometry ? kGeometryStates : 1][kTilePixels];
  T::ray_lengths(view, tile_x, tile_y, length);
  unsigned alive = T::start(view, tile_x, tile_y, through);
  for (Real* channel : {red, green, blue}) std::fill(channel, channel + kTilePixels, Real(0));
  if constexpr (kGeometry)
    for (auto& plane : geo) std::fill(plane, plane + kTilePixels, Real(0));

  const uint32_t end = P.lists.tile_begin[tile + 1];
  for (uint32_t begin = P.lists.tile_begin[tile]; begin < end; begin += kChunk) {
    const int count = int(std::min<uint32_t>(kChunk, end - begin));
    uint32_t* blocks = P.lists.blocks + begin;
    uint32_t touched[kChunk] = {};
    const typename Kind::Record* record[kChunk];
    if (alive)
      for (int i = 0; i < count; ++i) {
        record[i] = &records[P.lists.primitive[begin + i]];
        __builtin_prefetch(record[i]), __builtin_prefetch(reinterpret_cast<const char*>(record[i]) + 64);
      }
    if constexpr (kGeometry)
      for (int i = 0; i < count; ++i)
        P.pair_weight[P.lists.slot[begin + i]] = 0, P.pair_pixels[P.lists.slot[begin + i]] = 0;

    for (unsigned left = alive; left; left &= left - 1) {
      const int block = std::countr_zero(left);
      const uint32_t here = column(blocks, count, block);
      unsigned open = 0;
      for (int part = 0; part < T::kParts; ++part) {
        const int at = block * 16 + part * W;
        const V x = lanes.x + V::set(Real(tile_x + 4 * (block & 3) + T::part_x(part)));
        const V y = lanes.y + V::set(Real(tile_y + 4 * (block >> 2) + T::part_y(part)));
        const V v_length = V::load(length + at);
        V t = V::load(through + at), r = V::load(red + at), g = V::load(green + at), b = V::load(blue + at);
        unsigned going = (t >= v_stop).bits();
        for (uint32_t todo = here; todo && going;) {
          V taus[kGroup], t_in[kGeometry ? kGroup : 1], t_out[kGeometry ? kGroup : 1];
          I in_face[kGeometry ? kGroup : 1];
          M hits[kGroup];
          int entry[kGroup], kept = 0;
          for (int k = 0; k < kGroup && todo; ++k, todo &= todo - 1) {
            const int i = std::countr_zero(todo);
            const auto& R = *record[i];
            typename Kind::Intersection m;
            const M hit =
                Kind::template intersect<kGeometry>(R, view, x - V::set(R.ref_x), y - V::set(R.ref_y), v_length, m);
            taus[kept] = Kind::thickness(R, v_length, hit, m);
            if constexpr (kGeometry) Kind::depths(R, v_length, m, t_in[kept], t_out[kept]), in_face[kept] = m.in_face;
            hits[kept] = hit, entry[kept] = i;
            kept += hit.bits() != 0;
            visited += W;
          }
          for (int k = 0; k < kept; ++k) {
            const auto& R = *record[entry[k]];
            const M hit = hits[k] & (t >= v_stop);
            V alpha, e_tau;
            Kind::attenuate(R, taus[k], alpha, e_tau);
            const V weight = select(hit, t * alpha, zero), after = t * e_tau;
            r = fma(weight, V::set(R.rgb[0]), r), g = fma(weight, V::set(R.rgb[1]), g),
            b = fma(weight, V::set(R.rgb[2]), b);
            const unsigned bits = hit.bits();
            hit_lanes += unsigned(std::popcount(bits));
            touched[entry[k]] |= unsigned(bits != 0) << block;
            if constexpr (kGeometry) {
              const uint32_t slot = P.lists.slot[begin + entry[k]];
              P.pair_weight[slot] = std::max(P.pair_weight[slot], max_lane(weight)),
              P.pair_pixels[slot] += unsigned(std::popcount(bits));
              blend_geometry<Kind>(R, P.normals[P.lists.primitive[begin + entry[k]]], v_length, hit, in_face[k], t,
                                   after, taus[k], alpha, e_tau, weight, t_in[k], t_out[k], Real(view.level), geo, at);
            }
            t = select(hit, after, t);
          }
          going = (t >= v_stop).bits();
        }
        t.store(through + at), r.store(red + at), g.store(green + at), b.store(blue + at);
        open |= going;
      }
      if (!open) alive &= ~(1u << block);
    }
    std::copy(touched, touched + count, blocks);
  }
  store_pixels<Real, W, kGeometry>(P, tile_x, tile_y, red, green, blue, through, geo);
  return {visited, hit_lanes};
}

// Per-pixel state of the backward pass: the contribution still ahead along the ray, and the incoming gradients.
template <class Real, int W, bool kGeometry>
struct Incoming {
  // remaining = sum, over everything still ahead along the ray (background included), of its weight times (its value .
  // gradient).
  alignas(64) Real length[kTilePixels], through[kTilePixels], remaining[kTilePixels], red[kTilePixels],
      green[kTilePixels], blue[kTilePixels], one[kTilePixels];
  // Gradients to moment 1, moment 2, first depth, median depth, normal, median normal; then reference depth, 1/(density
  // |v|), and whether a primitive was hit.
  enum {
    kMoment1,
    kMoment2,
    kFirst,
    kMedian,
    kNormal,
    kMedianNormal = kNormal + 3,
    kReference = kMedianNormal + 3,
    kSlowness,
    kSeen,
    kStates
  };
  alignas(64) Real geo[kGeometry ? kStates : 1][kTilePixels];

  // Loads the planes of one tile; writes the tile's share of the background's gradient.
  void load(const RasterParams<Real>& P, int tile, int tile_x, int tile_y) {
    using T = Tile<Real, W>;
    using V = Vec<Real, W>;
    const View& view = P.view;
    const int64_t plane = int64_t(view.width) * view.height;
    T::ray_lengths(view, tile_x, tile_y, length);
    T::start(view, tile_x, tile_y, through);
    auto get = [&](const Real* from, int channel, Real* state) {
      T::load(view, tile_x, tile_y, from ? from + channel * plane : nullptr, state);
    };
    alignas(64) Real opacity[kTilePixels], value[3][kTilePixels];
    get(P.out.opacity, 0, opacity);
    for (int k = 0; k < 3; ++k) get(P.out.rgb, k, value[k]);
    get(P.grad.rgb, 0, red), get(P.grad.rgb, 1, green), get(P.grad.rgb, 2, blue), get(P.grad.opacity, 0, one);
    V background[3] = {V::set(0), V::set(0), V::set(0)};
    for (int i = 0; i < kTilePixels; i += W) {
      const V r = V::load(red + i), g = V::load(green + i), b = V::load(blue + i);
      fma(r, V::load(value[0] + i), fma(g, V::load(value[1] + i), b * V::load(value[2] + i))).store(remaining + i);
      const V t = V::set(1) - V::load(opacity + i);  // outside the image this is 1, but the gradients there are 0
      background[0] = fma(t, r, background[0]), background[1] = fma(t, g, background[1]),
      background[2] = fma(t, b, background[2]);
    }
    for (int k = 0; k < 3; ++k) P.background_sums[3 * tile + k] = sum(background[k]);
    if constexpr (kGeometry) {
      alignas(64) Real m1[kTilePixels], m2[kTilePixels], distortion[kTilePixels], normal[3][kTilePixels];
      get(P.out.state, 0, geo[kReference]), get(P.out.state, 1, m1), get(P.out.state, 2, m2),
          get(P.out.state, 3, geo[kSlowness]);
      get(P.grad.depth_expected, 0, geo[kMoment1]), get(P.grad.distortion, 0, distortion);
      get(P.grad.depth_first, 0, geo[kFirst]), get(P.grad.depth_median, 0, geo[kMedian]);
      for (int k = 0; k < 3; ++k)
        get(P.grad.normal, k, geo[kNormal + k]), get(P.grad.normal_median, k, geo[kMedianNormal + k]),
            get(P.out.normal, k, normal[k]);
      std::fill(geo[kSeen], geo[kSeen] + kTilePixels, Real(0));
      for (int i = 0; i < kTilePixels; ++i) {
        one[i] += geo[kMoment1][i] * geo[kReference][i] + distortion[i] * m2[i];
        geo[kMoment1][i] -= 2 * m1[i] * distortion[i];
        geo[kMoment2][i] = distortion[i] * opacity[i];
        remaining[i] += geo[kMoment1][i] * m1[i] + geo[kMoment2][i] * m2[i] + geo[kNormal][i] * normal[0][i] +
                        geo[kNormal + 1][i] * normal[1][i] + geo[kNormal + 2][i] * normal[2][i];
      }
    }
    for (int i = 0; i < kTilePixels; ++i) remaining[i] += one[i] * opacity[i];
  }
};

// Backward pass of blending one primitive into a part of a block: adds to the primitive's sums and removes it from the
// remaining contribution.
template <class Kind, bool kGeometry>
inline void blend_backward(const typename Kind::Record& record, const typename Kind::Real (*normals)[3],
                           const View& view, Incoming<typename Kind::Real, Kind::kWidth, kGeometry>& state,
                           const typename Kind::Intersection& m, Mask<typename Kind::Real, Kind::kWidth> met,
                           Vec<typename Kind::Real, Kind::kWidth> tau, int at,
                           Vec<typename Kind::Real, Kind::kWidth> px, Vec<typename Kind::Real, Kind::kWidth> py,
                           Vec<typename Kind::Real, Kind::kWidth>* sums) {
  using Real = typename Kind::Real;
  using V = Vec<Real, Kind::kWidth>;
  using M = Mask<Real, Kind::kWidth>;
  using S = Incoming<Real, Kind::kWidth, kGeometry>;
  const V zero = V::set(0), t = V::load(state.through + at);
  const M hit = met & (t >= V::set(Real(view.stop)));
  V alpha, e_tau;
  Kind::attenuate(record, tau, alpha, e_tau);
  const V after = t * e_tau, weight = select(hit, t * alpha, zero);
  const V gr = V::load(state.red + at), gg = V::load(state.green + at), gb = V::load(state.blue + at);
  V value = fma(V::set(record.rgb[0]), gr,
                fma(V::set(record.rgb[1]), gg, fma(V::set(record.rgb[2]), gb, V::load(state.one + at))));
  V d_in = zero, d_out = zero, d_tau_direct = zero, d_density_direct = zero;  // gradients to t_in, t_out, tau, density
  const V v_length = V::load(state.length + at);
  if constexpr (kGeometry) {
    auto from = [&](int plane) { return V::load(state.geo[plane] + at); };
    V t_in, t_out;
    Kind::depths(record, v_length, m, t_in, t_out);
    V z = t_in, mean = zero, slope = zero;
    if constexpr (Kind::kVolume) {
      mean_in_slice(tau, alpha, e_tau, mean, slope);
      z = fma(t_out - t_in, mean, t_in);
    }
    const V dz = select(hit, z - from(S::kReference), zero), g1 = from(S::kMoment1), g2 = from(S::kMoment2);
    value = value + dz * fma(dz, g2, g1);
    const V g_z = weight * fma(dz + dz, g2, g1);
    d_in = g_z * (V::set(1) - mean), d_out = g_z * mean, d_tau_direct = select(hit, g_z * (t_out - t_in) * slope, zero);

    const M fresh = hit & (from(S::kSeen) < V::set(Real(0.5)));
    select(fresh, V::set(1), from(S::kSeen)).store(state.geo[S::kSeen] + at);
    d_in = d_in + select(fresh, from(S::kFirst), zero);

    const V v_level = V::set(Real(view.level)), g_median = from(S::kMedian);
    const M crossing = hit & (v_level < t) & (v_level >= after);
    d_in = d_in + select(crossing, g_median, zero);
    if constexpr (Kind::kVolume) {
      const V slowness = from(S::kSlowness);
      d_tau_direct = d_tau_direct - select(hit & (v_level < after), g_median * slowness, zero);
      if (crossing.bits()) {
        const V inside = log(select(crossing, t * V::set(Real(1 / view.level)), V::set(1))) * slowness;
        d_density_direct = zero - select(crossing, g_median * inside * rcp(V::set(record.density)), zero);
      }
    }
    for (int f = 0; f < 4; ++f) {
      const M here = hit & equal(m.in_face, f);
      if (!here.bits()) continue;
      const M median_here = here & crossing;
      for (int k = 0; k < 3; ++k) {
        const V g_normal = from(S::kNormal + k);
        value = fma(select(here, V::set(normals[f][k]), zero), g_normal, value);
        V& s = sums[Sum::normal + 3 * f + k];
        s = fma(select(here, weight, zero), g_normal, s);
        s = s + select(median_here, from(S::kMedianNormal + k), zero);
      }
    }
  }
  const V rest = V::load(state.remaining + at) - weight * value;
  const V d_tau = select(hit, fma(after, value, d_tau_direct - rest), zero);
  sums[Sum::rgb] = fma(weight, gr, sums[Sum::rgb]);
  sums[Sum::rgb + 1] = fma(weight, gg, sums[Sum::rgb + 1]);
  sums[Sum::rgb + 2] = fma(weight, gb, sums[Sum::rgb + 2]);
  Kind::template add_gradient<Kind, kGeometry>(record, m, hit, v_length, e_tau, d_tau, d_in, d_out, d_density_direct,
                                               px, py, sums);
  rest.store(state.remaining + at);
  select(hit, after, t).store(state.through + at);
}

// Origin, within a tile, of the positions in a pair's sums: the reference pixel, or the tile's pixel nearest to it.
// This avoids cancellation in sums near the reference.
template <class Real>
inline Real origin_in_tile(Real reference, int tile) {
  return std::clamp(reference - Real(tile), Real(0), Real(kTile - 1));
}

// Returns the same object but hides its identity from the compiler, which would otherwise copy a record's fields to the
// stack before a loop over few entries.
template <class T>
inline const T& opaque(const T& object) {
  const T* p = &object;
  asm("" : "+r"(p));
  return *p;
}

template <class Kind, bool kGeometry>
void backward_center(const RasterParams<typename Kind::Real>& P, int tile, void*) {
  using Real = typename Kind::Real;
  constexpr int W = Kind::kWidth;
  using T = Tile<Real, W>;
  using V = typename T::V;
  using M = typename T::M;
  constexpr int kSums = kGeometry ? Kind::kGeometrySums : Kind::kColorSums;
  constexpr int kReady = 4;  // entries that are intersected before they are blended
  constexpr int kAhead = 6;  // pairs whose records are fetched before their turn
  const View& view = P.view;
  const int tile_x = tile % P.tiles_x * kTile, tile_y = tile / P.tiles_x * kTile;
  const Lanes<Real, W> lanes;
  const auto* records = static_cast<const typename Kind::Record*>(P.records);
  Incoming<Real, W, kGeometry> state;
  state.load(P, tile, tile_x, tile_y);

  const uint32_t end = P.lists.tile_begin[tile + 1];
  for (uint32_t e = P.lists.tile_begin[tile]; e < end; ++e) {
    Real* slot = P.sums + int64_t(P.lists.slot[e]) * kSums;
    unsigned todo = P.lists.blocks[e];
    if (todo == 0) {
      std::fill(slot, slot + kSums, Real(0));
      continue;
    }
    if (e + kAhead < end) {
      const char* next = reinterpret_cast<const char*>(&records[P.lists.primitive[e + kAhead]]);
      for (size_t line = 0; line < sizeof(typename Kind::Record); line += 64) __builtin_prefetch(next + line);
    }
    const auto& record_of_pair = records[P.lists.primitive[e]];
    const Real origin_x = origin_in_tile(record_of_pair.ref_x, tile_x),
               origin_y = origin_in_tile(record_of_pair.ref_y, tile_y);
    const V from_x = V::set(Real(tile_x) + origin_x - record_of_pair.ref_x),
            from_y = V::set(Real(tile_y) + origin_y - record_of_pair.ref_y);
    V sums[kSums];
    for (V& s : sums) s = V::set(0);
    int part = 0;
    while (todo) {
      typename Kind::Intersection ready[kReady];
      V taus[kReady];
      M met[kReady];
      int places[kReady], count = 0;
      for (int k = 0; k < kReady && todo; ++k) {
        const auto& record = opaque(record_of_pair);
        const int block = std::countr_zero(todo);
        const V px = lanes.x + V::set(Real(4 * (block & 3) + T::part_x(part)) - origin_x);
        const V py = lanes.y + V::set(Real(4 * (block >> 2) + T::part_y(part)) - origin_y);
        const int at = block * 16 + part * W;
        const V v_length = V::load(state.length + at);
        met[count] = Kind::template intersect<true>(record, view, px + from_x, py + from_y, v_length, ready[count]);
        taus[count] = Kind::thickness(record, v_length, met[count], ready[count]);
        places[count] = at;
        count += T::kParts == 1 || met[count].bits() != 0;
        if (++part == T::kParts) part = 0, todo &= todo - 1;
      }
      for (int k = 0; k < count; ++k) {
        const auto& record = opaque(record_of_pair);
        const int at = places[k], block = at / 16, place = at % 16 / W;
        const V px = lanes.x + V::set(Real(4 * (block & 3) + T::part_x(place)) - origin_x);
        const V py = lanes.y + V::set(Real(4 * (block >> 2) + T::part_y(place)) - origin_y);
        blend_backward<Kind, kGeometry>(record, kGeometry ? P.normals[P.lists.primitive[e]] : nullptr, view, state,
                                        ready[k], met[k], taus[k], at, px, py, sums);
      }
    }
    reduce(sums, kSums, slot);
    Kind::recenter(record_of_pair, Real(tile_x) + origin_x, Real(tile_y) + origin_y, slot);
  }
}

}  // namespace linprim::LINPRIM_ISA
