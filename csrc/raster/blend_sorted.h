// Blending per ray: primitives one after another by entry depth, or with densities added up where they overlap; and the
// backward passes.
//
// A tile list is sorted by a lower bound of each primitive's depth (ProjectParams::key). For the W rays of a part of a
// block, a window holds the primitives that some ray is currently intersection. The next primitive enters the window as
// soon as a ray could meet it before its next event. Every ray advances from event to event by itself, but the loops
// run over the window, which is the same for all rays, so no gather or scatter is needed.
#pragma once

#include <limits>

#include "raster/blend_center.h"

namespace linprim::LINPRIM_ISA {

// The primitives of one tile list that a part of a block currently meets. Candidate needs members `record`, `entry`.
template <class Kind, class Candidate>
class Window {
 public:
  using Real = typename Kind::Real;
  static int64_t bytes(int64_t longest_list) {
    return (longest_list + 1) * int64_t(sizeof(Candidate) + 2 * sizeof(int32_t));
  }
  Window(const RasterParams<Real>& P, int tile, void* scratch, int64_t capacity)
      : P_(P),
        end_(P.lists.tile_begin[tile + 1]),
        candidates_(static_cast<Candidate*>(scratch)),
        members_(reinterpret_cast<int32_t*>(candidates_ + capacity + 1)),
        free_(members_ + capacity + 1),
        begin_(P.lists.tile_begin[tile]) {}
  // Restarts the list for a part of a block.
  void start(int block) {
    block_ = block, at_ = begin_, count_ = free_count_ = used_ = 0;
    skip();
  }
  bool more() const { return at_ < end_; }
  // Lower bound of the depth of primitives that are not in the window yet.
  Real bound() const { return at_ < end_ ? P_.key[P_.lists.primitive[at_]] : std::numeric_limits<Real>::infinity(); }
  // Adds the next primitive, which the caller keeps or drops.
  Candidate& take() {
    const int id = free_count_ ? free_[--free_count_] : used_++;
    members_[count_++] = id;
    Candidate& c = candidates_[id];
    c.entry = at_, c.record = &static_cast<const typename Kind::Record*>(P_.records)[P_.lists.primitive[at_]];
    ++at_;
    skip();
    return c;
  }
  void drop_last() { free_[free_count_++] = members_[--count_]; }
  int size() const { return count_; }
  Candidate& operator[](int i) { return candidates_[members_[i]]; }
  // Removes the candidates for which finished(candidate) holds, keeping the order of the others.
  template <class Finished>
  void remove(Finished finished) {
    int kept = 0;
    for (int i = 0; i < count_; ++i) {
      if (finished(candidates_[members_[i]])) {
        free_[free_count_++] = members_[i];
      } else {
        members_[kept++] = members_[i];
      }
    }
    count_ = kept;
  }

 private:
  void skip() {
    while (at_ < end_ && !(P_.lists.blocks[at_] >> block_ & 1)) ++at_;
  }
  const RasterParams<Real>& P_;
  uint32_t end_;
  Candidate* candidates_;
  int32_t *members_, *free_;
  uint32_t begin_, at_ = 0;
  int block_ = 0, count_ = 0, free_count_ = 0, used_ = 0;
};

template <class Real>
constexpr Real kNever = Real(1e30);  // later than every event

// A part of a block: its position and the pixels of its rays.
template <class Real, int W>
struct Part {
  using V = Vec<Real, W>;
  int at;    // into the state arrays
  V px, py;  // position in the tile
  V x, y;    // in the image
  Part(const Lanes<Real, W>& lanes, int tile_x, int tile_y, int block, int part) {
    using T = Tile<Real, W>;
    at = block * 16 + part * W;
    px = lanes.x + V::set(Real(4 * (block & 3) + T::part_x(part))),
    py = lanes.y + V::set(Real(4 * (block >> 2) + T::part_y(part)));
    x = px + V::set(Real(tile_x)), y = py + V::set(Real(tile_y));
  }
};

// ---- By entry depth
// -----------------------------------------------------------------------------------------------------

template <class Kind, bool kBackward, bool kGeometry>
struct EntryCandidate {
  using Real = typename Kind::Real;
  using V = Vec<Real, Kind::kWidth>;
  const typename Kind::Record* record;
  uint32_t entry;
  typename Kind::Intersection intersection;
  Mask<Real, Kind::kWidth> waiting;  // hit, and not blended yet
  V tau, t_in, t_out;
  V sums[kBackward ? (kGeometry ? Kind::kGeometrySums : Kind::kColorSums) : 1];
};

// Calls blend(candidate, mask) for the rays of a part, for each ray in the order of its entry depths, while open() has
// rays that have not ended; finish(candidate) when a candidate leaves.
template <class Kind, bool kTrack, class Candidate, class Begin, class Open, class Blend, class Finish>
inline void sweep_entries(Window<Kind, Candidate>& window, const View& view,
                          const Part<typename Kind::Real, Kind::kWidth>& part,
                          Vec<typename Kind::Real, Kind::kWidth> v_length, Begin begin, Open open, Blend blend,
                          Finish finish) {
  using Real = typename Kind::Real;
  using V = Vec<Real, Kind::kWidth>;
  using M = Mask<Real, Kind::kWidth>;
  const V never = V::set(kNever<Real>);
  V last = V::set(-kNever<Real>);  // depths never decrease along a ray
  for (M going = open(); going.bits(); going = open()) {
    V next = never;
    for (int i = 0; i < window.size(); ++i) next = min(next, select(window[i].waiting & going, window[i].t_in, never));
    // The largest of the next entry depths, over the rays that have one.
    auto latest = [&] { return max_lane(select(going & (next < never), next, V::set(-kNever<Real>))); };
    while (window.more() && (window.bound() <= latest() || !(going & (next < never)).bits())) {
      Candidate& c = window.take();
      c.waiting = Kind::template intersect<kTrack>(*c.record, view, part.x - V::set(c.record->ref_x),
                                                   part.y - V::set(c.record->ref_y), v_length, c.intersection);
      if (!(c.waiting & going).bits()) {
        window.drop_last();
        continue;
      }
      c.tau = Kind::thickness(*c.record, v_length, c.waiting, c.intersection);
      Kind::depths(*c.record, v_length, c.intersection, c.t_in, c.t_out);
      c.t_in = max(c.t_in, last);
      begin(c);
      next = min(next, select(c.waiting & going, c.t_in, never));
    }
    if (!(going & (next < never)).bits()) break;
    for (int i = 0; i < window.size(); ++i) {
      Candidate& c = window[i];
      const M now = c.waiting & going & (next >= c.t_in);
      if (!now.bits()) continue;
      blend(c, now);
      c.waiting = c.waiting & (next < c.t_in);
    }
    last = select(next < never, next, last);
    window.remove([&](Candidate& c) {
      if ((c.waiting & going).bits()) return false;
      finish(c);
      return true;
    });
  }
  window.remove([&](Candidate& c) { return finish(c), true; });
}

template <class Kind, bool kGeometry>
Counts forward_entry(const RasterParams<typename Kind::Real>& P, int tile, void* scratch) {
  using Real = typename Kind::Real;
  constexpr int W = Kind::kWidth;
  using T = Tile<Real, W>;
  using V = typename T::V;
  using M = typename T::M;
  using Candidate = EntryCandidate<Kind, false, kGeometry>;
  const View& view = P.view;
  const int tile_x = tile % P.tiles_x * kTile, tile_y = tile / P.tiles_x * kTile;
  const Lanes<Real, W> lanes;
  const V zero = V::set(0), v_stop = V::set(Real(view.stop));
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
      V t = V::load(through + at), r = zero, g = zero, b = zero;
      window.start(block);
      sweep_entries<Kind, kGeometry>(
          window, view, part, v_length, [&](Candidate&) { visited += W; }, [&] { return t >= v_stop; },
          [&](Candidate& c, M now) {
            const auto& R = *c.record;
            const M hit = now & (t >= v_stop);
            V alpha, e_tau;
            Kind::attenuate(R, c.tau, alpha, e_tau);
            const V weight = select(hit, t * alpha, zero), after = t * e_tau;
            r = fma(weight, V::set(R.rgb[0]), r), g = fma(weight, V::set(R.rgb[1]), g),
            b = fma(weight, V::set(R.rgb[2]), b);
            const unsigned count = unsigned(std::popcount(hit.bits()));
            hit_lanes += count;
            if constexpr (kGeometry) {
              const uint32_t slot = P.lists.slot[c.entry];
              P.pair_weight[slot] = std::max(P.pair_weight[slot], max_lane(weight)), P.pair_pixels[slot] += count;
              blend_geometry<Kind>(R, P.normals[P.lists.primitive[c.entry]], v_length, hit, c.intersection.in_face, t,
                                   after, c.tau, alpha, e_tau, weight, c.t_in, c.t_out, Real(view.level), geo, at);
            }
            t = select(hit, after, t);
          },
          [](Candidate&) {});
      t.store(through + at), r.store(red + at), g.store(green + at), b.store(blue + at);
    }
  store_pixels<Real, W, kGeometry>(P, tile_x, tile_y, red, green, blue, through, geo);
  return {visited, hit_lanes};
}

// Adds a finished candidate's sums to its gradient slot.
template <class Kind, int kSums>
inline void add_to_slot(const typename Kind::Record& record, const Vec<typename Kind::Real, Kind::kWidth>* sums,
                        int tile_x, int tile_y, typename Kind::Real* slot) {
  alignas(64) typename Kind::Real own[kSums];
  reduce(sums, kSums, own);
  using Real = typename Kind::Real;
  Kind::recenter(record, Real(tile_x) + origin_in_tile(record.ref_x, tile_x),
                 Real(tile_y) + origin_in_tile(record.ref_y, tile_y), own);
  for (int i = 0; i < kSums; ++i) slot[i] += own[i];
}

template <class Kind, bool kGeometry>
void backward_entry(const RasterParams<typename Kind::Real>& P, int tile, void* scratch) {
  using Real = typename Kind::Real;
  constexpr int W = Kind::kWidth;
  using T = Tile<Real, W>;
  using V = typename T::V;
  using M = typename T::M;
  using Candidate = EntryCandidate<Kind, true, kGeometry>;
  constexpr int kSums = kGeometry ? Kind::kGeometrySums : Kind::kColorSums;
  const View& view = P.view;
  const int tile_x = tile % P.tiles_x * kTile, tile_y = tile / P.tiles_x * kTile;
  const Lanes<Real, W> lanes;
  Incoming<Real, W, kGeometry> state;
  state.load(P, tile, tile_x, tile_y);
  const uint32_t first = P.lists.tile_begin[tile], end = P.lists.tile_begin[tile + 1];
  auto slot_of = [&](uint32_t entry) { return P.sums + int64_t(P.lists.slot[entry]) * kSums; };
  for (uint32_t e = first; e < end; ++e) std::fill(slot_of(e), slot_of(e) + kSums, Real(0));
  Window<Kind, Candidate> window(P, tile, scratch, end - first);

  for (int block = 0; block < kBlocks; ++block)
    for (int p = 0; p < T::kParts; ++p) {
      const Part<Real, W> part(lanes, tile_x, tile_y, block, p);
      window.start(block);
      sweep_entries<Kind, true>(
          window, view, part, V::load(state.length + part.at),
          [](Candidate& c) { std::fill(c.sums, c.sums + kSums, V::set(0)); },
          [&] { return V::load(state.through + part.at) >= V::set(Real(view.stop)); },
          [&](Candidate& c, M now) {
            blend_backward<Kind, kGeometry>(*c.record, kGeometry ? P.normals[P.lists.primitive[c.entry]] : nullptr,
                                            view, state, c.intersection, now, c.tau, part.at,
                                            part.px - V::set(origin_in_tile(c.record->ref_x, tile_x)),
                                            part.py - V::set(origin_in_tile(c.record->ref_y, tile_y)), c.sums);
          },
          [&](Candidate& c) { add_to_slot<Kind, kSums>(*c.record, c.sums, tile_x, tile_y, slot_of(c.entry)); });
    }
}

}  // namespace linprim::LINPRIM_ISA
