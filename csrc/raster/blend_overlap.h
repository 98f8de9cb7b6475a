// Exact overlap: the emission-absorption integral, where the densities of overlapping primitives add up, segment by
// segment, and its backward pass.
//
// Between two events (entries, exits) of a ray, the density sigma = sum_i sigma_i of the primitives that contain it is
// constant, and so is their emission sum_i sigma_i c_i. With T0 the transmittance at the start of a segment of optical
// thickness tau and length L,
//   X_k = integral of x^k T over the segment = T0 L^(k+1) phi_k(tau),   phi_k(tau) = integral of x^k exp(-tau x) over
//   [0, 1],
// gives every output: primitive i's weight increases by sigma_i X_0, the colour by c_i times that, the depths by X_1
// and X_2. Backward pass: with e_i the gradient to the weight of i, h(t) that of the depths, and R(t) the contribution
// still ahead of a ray at depth t,
//   dL/dsigma_i = integral over i's interval of T (e_i + h) - R,   dL/dt_out_i = sigma_i (T (e_i + h) - R) at t_out_i,
// and the negative of that at t_in_i. Model: Mai et al. 2024 (EVER, arXiv 2410.01804), here for any convex polyhedra.
#pragma once

#include "raster/blend_sorted.h"

namespace linprim::LINPRIM_ISA {

// Computes phi_0 .. phi_(kCount-1) of tau >= 0, with alpha = 1 - exp(-tau) and through = exp(-tau). Above a limit of
// 0.7 by the recursion phi_k = (k phi_(k-1) - exp(-tau)) / tau, whose relative error grows at most by k! / tau^k there;
// below it by the series of the last, sum_j (-tau)^j / (j! (kCount + j)), and the same recursion downwards, which loses
// no precision.
template <int kCount, class Real, int W>
inline void slice_moments(Vec<Real, W> tau, Vec<Real, W> alpha, Vec<Real, W> through, Vec<Real, W>* phi) {
  using V = Vec<Real, W>;
  constexpr int kTerms = sizeof(Real) == 4 ? 9 : 17;  // next term below 1e-9, 1e-17
  const Mask<Real, W> thin = tau < V::set(Real(0.7));
  const V small = select(thin, tau, V::set(0)), inverse = rcp(select(thin, V::set(1), tau));
  V series = V::set(0);
  for (int j = kTerms - 1; j >= 0; --j) {
    double coefficient = 1.0 / (kCount + j);
    for (int i = 1; i <= j; ++i) coefficient /= -i;
    series = fma(series, small, V::set(Real(coefficient)));
  }
  V down[kCount];
  down[kCount - 1] = series;
  for (int k = kCount - 1; k > 0; --k) down[k - 1] = fma(small, down[k], through) * V::set(Real(1.0 / k));
  V up = alpha * inverse;
  for (int k = 0; k < kCount; ++k) {
    phi[k] = select(thin, down[k], up);
    up = fma(V::set(Real(k + 1)), up, V::set(0) - through) * inverse;
  }
}

template <class Kind, bool kBackward, bool kGeometry>
struct OverlapCandidate {
  using Real = typename Kind::Real;
  using V = Vec<Real, Kind::kWidth>;
  const typename Kind::Record* record;
  uint32_t entry, pixels;
  typename Kind::Intersection intersection;
  V t_in, t_out;                               // both before every event if the ray misses
  V rate;                                      // density per unit of z-depth
  V weight;                                    // integral of T density over its interval so far
  V value, d_density, d_in, d_out;             // backward: gradient to weight, gradients accumulated so far
  V d_median[kBackward && kGeometry ? 4 : 1];  // to the normals of slots 0-3 at the median: their common factor
};

// Advances the rays of a part from event to event while open() has rays that have not ended. Calls begin(candidate,
// rays that meet it); then, from each event to the next, segment(now, next, rays that have a next event); and
// finish(candidate) when no ray meets it any more.
template <class Kind, bool kTrack, class Candidate, class Begin, class Open, class Segment, class Finish>
inline void sweep_overlaps(Window<Kind, Candidate>& window, const View& view,
                           const Part<typename Kind::Real, Kind::kWidth>& part,
                           Vec<typename Kind::Real, Kind::kWidth> v_length, Begin begin, Open open, Segment segment,
                           Finish finish) {
  using Real = typename Kind::Real;
  using V = Vec<Real, Kind::kWidth>;
  using M = Mask<Real, Kind::kWidth>;
  const V never = V::set(kNever<Real>), before = V::set(-kNever<Real>);
  V now = before;
  for (M going = open(); going.bits(); going = open()) {
    auto next_of = [&](const Candidate& c) {
      return select(now < c.t_in, c.t_in, select(now < c.t_out, c.t_out, never));
    };
    V next = never;
    for (int i = 0; i < window.size(); ++i) next = min(next, next_of(window[i]));
    next = select(going, next, never);
    auto latest = [&] { return max_lane(select(next < never, next, before)); };
    while (window.more() && (window.bound() <= latest() || !(next < never).bits())) {
      Candidate& c = window.take();
      const M hit =
          going & Kind::template intersect<kTrack>(*c.record, view, part.x - V::set(c.record->ref_x),
                                                   part.y - V::set(c.record->ref_y), v_length, c.intersection);
      Kind::thickness(*c.record, v_length, hit, c.intersection);
      V t_in, t_out;
      Kind::depths(*c.record, v_length, c.intersection, t_in, t_out);
      // An interval that rounds to zero length is not a hit; depths never decrease along a ray.
      const M met = hit & (t_in < t_out) & (now < t_out);
      if (!met.bits()) {
        window.drop_last();
        continue;
      }
      c.t_in = select(met, max(t_in, now), before), c.t_out = select(met, t_out, before);
      c.rate = V::set(c.record->density) * v_length;
      begin(c, met);
      next = select(going, min(next, next_of(c)), never);
    }
    const M steps = next < never;
    if (!steps.bits()) break;
    segment(now, next, steps);
    now = select(steps, next, now);
    const M still = open();
    window.remove([&](Candidate& c) {
      if ((still & (now < c.t_out)).bits()) return false;
      finish(c);
      return true;
    });
  }
  window.remove([&](Candidate& c) { return finish(c), true; });
}

template <class Kind, bool kGeometry>
Counts forward_overlap(const RasterParams<typename Kind::Real>& P, int tile, void* scratch) {
  using Real = typename Kind::Real;
  constexpr int W = Kind::kWidth;
  using T = Tile<Real, W>;
  using V = typename T::V;
  using M = typename T::M;
  using Candidate = OverlapCandidate<Kind, false, kGeometry>;
  const View& view = P.view;
  const int tile_x = tile % P.tiles_x * kTile, tile_y = tile / P.tiles_x * kTile;
  const Lanes<Real, W> lanes;
  const V zero = V::set(0), v_stop = V::set(Real(view.stop)), v_level = V::set(Real(view.level));
  uint64_t visited = 0, hit_lanes = 0;
  alignas(64) Real length[kTilePixels], through[kTilePixels], red[kTilePixels], green[kTilePixels], blue[kTilePixels];
  alignas(64) Real geo[kGeometry ? kGeometryStates : 1][kTilePixels];
  T::ray_lengths(view, tile_x, tile_y, length);
  T::start(view, tile_x, tile_y, through);
  for (Real* channel : {red, green, blue}) std::fill(channel, channel + kTilePixels, Real(0));
  if constexpr (kGeometry)
    for (auto& plane : geo) std::fill(plane, plane + kTilePixels, Real(0));
  const uint32_t first = P.lists.tile_begin[tile], end = P.lists.tile_begin[tile + 1];
  if constexpr (kGeometry)
    for (uint32_t e = first; e < end; ++e) P.pair_weight[P.lists.slot[e]] = 0, P.pair_pixels[P.lists.slot[e]] = 0;
  Window<Kind, Candidate> window(P, tile, scratch, end - first);

  for (int block = 0; block < kBlocks; ++block)
    for (int p = 0; p < T::kParts; ++p) {
      const Part<Real, W> part(lanes, tile_x, tile_y, block, p);
      const int at = part.at;
      const V v_length = V::load(length + at);
      V t = V::load(through + at), color[3] = {zero, zero, zero};
      V seen = zero, origin = zero, first_depth = zero, m1 = zero, m2 = zero, median = zero, slowness = zero;
      V normal[3] = {zero, zero, zero}, median_normal[3] = {zero, zero, zero};
      window.start(block);
      sweep_overlaps<Kind, kGeometry>(
          window, view, part, v_length,
          [&](Candidate& c, M met) {
            visited += W, hit_lanes += unsigned(std::popcount(met.bits()));
            c.weight = zero, c.pixels = 0;
          },
          [&] { return t >= v_stop; },
          [&](V now, V next, M steps) {
            V sigma = zero, emission[3] = {zero, zero, zero}, facing[3] = {zero, zero, zero};
            for (int i = 0; i < window.size(); ++i) {
              const Candidate& c = window[i];
              const M inside = steps & (now >= c.t_in) & (now < c.t_out);
              const V rate = select(inside, c.rate, zero);
              sigma = sigma + rate;
              for (int k = 0; k < 3; ++k) emission[k] = fma(rate, V::set(c.record->rgb[k]), emission[k]);
              if constexpr (kGeometry)
                for (int f = 0; f < 4; ++f) {
                  const V share = select(equal(c.intersection.in_face, f), rate, zero);
                  for (int k = 0; k < 3; ++k)
                    facing[k] = fma(share, V::set(P.normals[P.lists.primitive[c.entry]][f][k]), facing[k]);
                }
            }
            // Before the first event nothing is absorbed: a length of 0 avoids NaN.
            const V length_here = select(steps & (V::set(-kNever<Real>) < now), next - now, zero),
                    tau = sigma * length_here;
            V alpha, e_tau, phi[1];
            exp_neg(tau, alpha, e_tau);
            slice_moments<1>(tau, alpha, e_tau, phi);
            const V x0 = t * length_here * phi[0], after = t * e_tau;
            for (int k = 0; k < 3; ++k) color[k] = fma(emission[k], x0, color[k]);
            if constexpr (kGeometry) {
              const V weight = select(steps, t * alpha, zero);
              V mean, slope;
              mean_in_slice(tau, alpha, e_tau, mean, slope);
              const M fresh = steps & (seen < V::set(Real(0.5)));
              seen = select(fresh, V::set(1), seen), first_depth = select(fresh, next, first_depth),
              origin = select(fresh, next, origin);
              const V dz = select(steps & (zero < weight), fma(length_here, mean, now - origin), zero);
              m1 = fma(weight, dz, m1), m2 = fma(weight, fma(dz, dz, zero - length_here * length_here * slope), m2);
              for (int k = 0; k < 3; ++k) normal[k] = fma(facing[k], x0, normal[k]);
              const M crossing = steps & (v_level < t) & (v_level >= after);
              if (crossing.bits()) {
                const V slow = rcp(select(crossing, sigma, V::set(1)));
                const V inside = log(select(crossing, t * V::set(Real(1 / view.level)), V::set(1))) * slow;
                median = select(crossing, min(now + inside, next), median), slowness = select(crossing, slow, slowness);
                for (int k = 0; k < 3; ++k) median_normal[k] = select(crossing, facing[k] * slow, median_normal[k]);
              }
              const M open = after >= v_stop;
              for (int i = 0; i < window.size(); ++i) {
                Candidate& c = window[i];
                const M inside = steps & (now >= c.t_in) & (now < c.t_out);
                c.weight = fma(select(inside, c.rate, zero), x0, c.weight);
                c.pixels += unsigned(std::popcount((steps & open & (now < c.t_in) & (next >= c.t_in)).bits()));
              }
            }
            t = select(steps, after, t);
          },
          [&](Candidate& c) {
            if constexpr (kGeometry) {
              const uint32_t slot = P.lists.slot[c.entry];
              P.pair_weight[slot] = std::max(P.pair_weight[slot], max_lane(c.weight)), P.pair_pixels[slot] += c.pixels;
            }
          });
      t.store(through + at), color[0].store(red + at), color[1].store(green + at), color[2].store(blue + at);
      if constexpr (kGeometry) {
        first_depth.store(geo[kFirst] + at), origin.store(geo[kReference] + at), m1.store(geo[kMoment1] + at),
            m2.store(geo[kMoment2] + at);
        median.store(geo[kMedian] + at), slowness.store(geo[kSlowness] + at);
        for (int k = 0; k < 3; ++k)
          normal[k].store(geo[kNormal + k] + at), median_normal[k].store(geo[kMedianNormal + k] + at);
      }
    }
  store_pixels<Real, W, kGeometry>(P, tile_x, tile_y, red, green, blue, through, geo);
  return {visited, hit_lanes};
}

// With affine rays, depths depend on the distance of the centre, whose sum is among the geometry sums.
template <class Kind, bool kGeometry>
constexpr int kOverlapSums = kGeometry || Kind::kRayModel == RayModel::kAffine ? Kind::kGeometrySums : Kind::kColorSums;

template <class Kind, bool kGeometry>
void backward_overlap(const RasterParams<typename Kind::Real>& P, int tile, void* scratch) {
  using Real = typename Kind::Real;
  constexpr int W = Kind::kWidth;
  using T = Tile<Real, W>;
  using V = typename T::V;
  using M = typename T::M;
  using Candidate = OverlapCandidate<Kind, true, kGeometry>;
  using S = Incoming<Real, W, kGeometry>;
  constexpr int kSums = kOverlapSums<Kind, kGeometry>;
  constexpr int kMoments = kGeometry ? 4 : 2;
  const View& view = P.view;
  const int tile_x = tile % P.tiles_x * kTile, tile_y = tile / P.tiles_x * kTile;
  const Lanes<Real, W> lanes;
  const V zero = V::set(0), v_stop = V::set(Real(view.stop)), v_level = V::set(Real(view.level));
  S state;
  state.load(P, tile, tile_x, tile_y);
  const uint32_t first = P.lists.tile_begin[tile], end = P.lists.tile_begin[tile + 1];
  auto slot_of = [&](uint32_t entry) { return P.sums + int64_t(P.lists.slot[entry]) * kSums; };
  for (uint32_t e = first; e < end; ++e) std::fill(slot_of(e), slot_of(e) + kSums, Real(0));
  Window<Kind, Candidate> window(P, tile, scratch, end - first);

  for (int block = 0; block < kBlocks; ++block)
    for (int p = 0; p < T::kParts; ++p) {
      const Part<Real, W> part(lanes, tile_x, tile_y, block, p);
      const int at = part.at;
      auto incoming = [&](int plane) { return V::load(state.geo[kGeometry ? plane : 0] + at); };
      const V v_length = V::load(state.length + at),
              grad[3] = {V::load(state.red + at), V::load(state.green + at), V::load(state.blue + at)};
      const V one = V::load(state.one + at);
      const V g1 = kGeometry ? incoming(S::kMoment1) : zero, g2 = kGeometry ? incoming(S::kMoment2) : zero;
      const V origin = kGeometry ? incoming(S::kReference) : zero;
      // The median depth depends on all the optical thickness before it: as if this much were always still ahead, up to
      // the crossing.
      const V pull = kGeometry ? zero - incoming(S::kMedian) * incoming(S::kSlowness) : zero;
      V t = V::load(state.through + at), rest = V::load(state.remaining + at);
      V crossed = zero, started = zero;  // 1 after the median, and after the first entry
      // h(t) = g1 (t - origin) + g2 (t - origin)^2.
      auto along = [&](V depth) { return (depth - origin) * fma(depth - origin, g2, g1); };
      window.start(block);
      sweep_overlaps<Kind, true>(
          window, view, part, v_length,
          [&](Candidate& c, M) {
            c.weight = c.d_density = c.d_in = c.d_out = zero;
            c.value = fma(V::set(c.record->rgb[0]), grad[0],
                          fma(V::set(c.record->rgb[1]), grad[1], fma(V::set(c.record->rgb[2]), grad[2], one)));
            if constexpr (kGeometry)
              for (int f = 0; f < 4; ++f) {
                c.d_median[f] = zero;
                for (int k = 0; k < 3; ++k)
                  c.value = fma(select(equal(c.intersection.in_face, f),
                                       V::set(P.normals[P.lists.primitive[c.entry]][f][k]), zero),
                                incoming(S::kNormal + k), c.value);
              }
          },
          [&] { return t >= v_stop; },
          [&](V now, V next, M steps) {
            V sigma = zero, emission = zero;  // emission: sum of rate times value
            for (int i = 0; i < window.size(); ++i) {
              const Candidate& c = window[i];
              const V rate = select(steps & (now >= c.t_in) & (now < c.t_out), c.rate, zero);
              sigma = sigma + rate, emission = fma(rate, c.value, emission);
            }
            const V length_here = select(steps & (V::set(-kNever<Real>) < now), next - now, zero),
                    tau = sigma * length_here;
            V alpha, e_tau, phi[kMoments], X[kMoments];
            exp_neg(tau, alpha, e_tau);
            slice_moments<kMoments>(tau, alpha, e_tau, phi);
            V power = t * length_here;
            // Powers of a length of 1e10 overflow single precision; with an upper limit, 0 times them stays 0.
            const V most = V::set(std::numeric_limits<Real>::max() / 1024);
            for (int k = 0; k < kMoments; ++k) X[k] = power * phi[k], power = min(power * length_here, most);
            const V after = t * e_tau;
            V bulk = zero,
              front = emission * X[1];  // integral of T h; integral of the segment's own contribution still ahead
            V before_median = length_here;
            M crossing = M::all(false);
            if constexpr (kGeometry) {
              const V from = select(V::set(-kNever<Real>) < now, now - origin, zero), p0 = from * fma(from, g2, g1),
                      p1 = fma(from + from, g2, g1);
              bulk = fma(p0, X[0], fma(p1, X[1], g2 * X[2]));
              // Multiply by the density first: a factor of depth times the cube of a length of 1e12 would overflow
              // single precision.
              front = fma(p0, sigma * X[1], fma(p1, sigma * X[2], fma(g2, sigma * X[3], front)));
              crossing = steps & (v_level < t) & (v_level >= after);
              const V inside = log(select(crossing, t * V::set(Real(1 / view.level)), V::set(1))) *
                               V::load(state.geo[S::kSlowness] + at);
              before_median =
                  select(crossed < V::set(Real(0.5)), select(crossing, min(inside, length_here), length_here), zero);
            }
            const V rest_after = rest - fma(sigma, bulk, emission * X[0]);
            // The contribution still ahead, integrated over the segment, per unit of density in it.
            V shade = fma(length_here, rest_after, front);
            if constexpr (kGeometry) shade = shade - pull * before_median;
            for (int i = 0; i < window.size(); ++i) {
              Candidate& c = window[i];
              const M inside = steps & (now >= c.t_in) & (now < c.t_out);
              c.weight = fma(select(inside, c.rate, zero), X[0], c.weight);
              c.d_density = c.d_density + select(inside, fma(c.value, X[0], bulk - shade), zero);
            }
            if constexpr (kGeometry) {
              if (crossing.bits()) {
                const V slow = V::load(state.geo[S::kSlowness] + at);
                V turned = zero;  // mean normal there times the gradient to it
                V own[3] = {incoming(S::kMedianNormal), incoming(S::kMedianNormal + 1), incoming(S::kMedianNormal + 2)};
                auto of = [&](const Candidate& c) {
                  V n = zero;
                  for (int f = 0; f < 4; ++f)
                    for (int k = 0; k < 3; ++k)
                      n = fma(select(equal(c.intersection.in_face, f),
                                     V::set(P.normals[P.lists.primitive[c.entry]][f][k]), zero),
                              own[k], n);
                  return n;
                };
                for (int i = 0; i < window.size(); ++i) {
                  const Candidate& c = window[i];
                  turned =
                      fma(select(crossing & (now >= c.t_in) & (now < c.t_out), c.rate, zero) * slow, of(c), turned);
                }
                for (int i = 0; i < window.size(); ++i) {
                  Candidate& c = window[i];
                  const M inside = crossing & (now >= c.t_in) & (now < c.t_out);
                  c.d_density = c.d_density + select(inside, (of(c) - turned) * slow, zero);
                  for (int f = 0; f < 4; ++f)
                    c.d_median[f] =
                        c.d_median[f] + select(inside & equal(c.intersection.in_face, f), c.rate * slow, zero);
                }
              }
              crossed = select(crossing, V::set(1), crossed);
            }
            // Events: the change of the loss when a boundary moves.
            V edge = zero - rest_after;
            if constexpr (kGeometry) edge = edge + select(crossed < V::set(Real(0.5)), pull, zero);
            const V depth_part = kGeometry ? along(select(steps, next, origin)) : zero;
            const M open = after >= v_stop;
            for (int i = 0; i < window.size(); ++i) {
              Candidate& c = window[i];
              const V gain = c.rate * fma(after, c.value + depth_part, edge);
              c.d_in = c.d_in - select(steps & open & (now < c.t_in) & (next >= c.t_in), gain, zero);
              c.d_out = c.d_out + select(steps & (now < c.t_out) & (next >= c.t_out), gain, zero);
              if constexpr (kGeometry)
                c.d_in = c.d_in + select(steps & (started < V::set(Real(0.5))) & (next >= c.t_in) & (now < c.t_in),
                                         incoming(S::kFirst), zero);
            }
            started = select(steps, V::set(1), started);
            rest = select(steps, rest_after, rest), t = select(steps, after, t);
          },
          [&](Candidate& c) {
            V sums[kSums];
            for (V& s : sums) s = zero;
            for (int k = 0; k < 3; ++k) sums[Sum::rgb + k] = c.weight * grad[k];
            const M met = c.t_in < c.t_out;
            if constexpr (kGeometry)
              for (int f = 0; f < 4; ++f)
                for (int k = 0; k < 3; ++k)
                  sums[Sum::normal + 3 * f + k] =
                      fma(select(equal(c.intersection.in_face, f), c.weight, zero), incoming(S::kNormal + k),
                          c.d_median[f] * incoming(S::kMedianNormal + k));
            Kind::template add_gradient<Kind, kSums == Kind::kGeometrySums>(
                *c.record, c.intersection, met, v_length, zero, zero, select(met, c.d_in, zero),
                select(met, c.d_out, zero), select(met, c.d_density * v_length, zero),
                part.px - V::set(origin_in_tile(c.record->ref_x, tile_x)),
                part.py - V::set(origin_in_tile(c.record->ref_y, tile_y)), sums);
            add_to_slot<Kind, kSums>(*c.record, sums, tile_x, tile_y, slot_of(c.entry));
          });
    }
}

}  // namespace linprim::LINPRIM_ISA
