// Optical depth along segments, in packets of neighbours; compiled once per instruction set like kernels.cpp.
#ifndef LINPRIM_ISA
#error "compile this file with -DLINPRIM_ISA=<name> -DLINPRIM_ISA_<NAME>=1"
#endif

#include "base/lanes.h"
#include "surface/segment_depth.h"

namespace linprim {
namespace LINPRIM_ISA {

// Size of the traversal stack. Each level of the hierarchy halves the number of solids, which is less than 2^31.
constexpr int kMostLevels = 64;
// Smallest rate of change of a coordinate along a segment. A smaller one is replaced by it, so that its inverse is
// finite: such a segment stays on its side of the plane.
constexpr double kSmallestRate = 1e-280;

inline D inverse_of(D rate) { return 1.0 / (vabs(rate) < kSmallestRate ? splat(kSmallestRate) : rate); }

// Segments that traverse the hierarchy together, one per lane: vector from origin to end and its inverses, fraction at
// which the segment begins, length of the vector, sum so far.
struct Packet {
  D direction[3], inverse[3], begin, length, sum;
};

// Returns which segments meet the box of a node (slab test).
inline B meets_box(const Packet& p, const SolidNode& node, const double* origin) {
  D in = p.begin, out = splat(1.0);
  for (int k = 0; k < 3; ++k) {
    const D a = (node.low[k] - origin[k]) * p.inverse[k], b = (node.high[k] - origin[k]) * p.inverse[k];
    in = vmax(in, vmin(a, b)), out = vmin(out, vmax(a, b));
  }
  return (B)(in <= out);
}

// Adds the density of a solid times the lengths of the segments inside its four slabs.
inline void add_solid(Packet& p, const SeenSolid& solid) {
  D in = p.begin, out = splat(1.0);
  for (int j = 0; j < 4; ++j) {
    const double* n = solid.normal[j];
    const D inverse = inverse_of(n[0] * p.direction[0] + n[1] * p.direction[1] + n[2] * p.direction[2]);
    const D a = (-1.0 - solid.at[j]) * inverse, b = (1.0 - solid.at[j]) * inverse;
    in = vmax(in, vmin(a, b)), out = vmin(out, vmax(a, b));
  }
  p.sum += solid.density * p.length * vmax(out - in, D{});
}

// Computes the depths of segments [begin, end). The near child, as seen from the origin, is visited first: the order of
// the sum is the same for every segment, and opaque segments end early.
inline void segment_depths(const SegmentParams& P, int64_t begin, int64_t end) {
  for (int64_t first = begin; first < end; first += kLanes) {
    const int lanes = int(end - first < kLanes ? end - first : kLanes);
    Packet p;
    for (int l = 0; l < kLanes; ++l) {
      const int64_t row = first + (l < lanes ? l : lanes - 1);
      double length2 = 0;
      for (int k = 0; k < 3; ++k) {
        const double d = P.ends[3 * row + k] - P.origin[k];
        p.direction[k][l] = d, length2 += d * d;
      }
      p.length[l] = std::sqrt(length2), p.begin[l] = P.begin ? P.begin[row] : 0.0;
    }
    for (int k = 0; k < 3; ++k) p.inverse[k] = inverse_of(p.direction[k]);
    p.sum = D{};
    int32_t stack[kMostLevels];
    int depth = 0;
    stack[depth++] = 0;
    while (depth) {
      const int32_t at = stack[--depth];
      const SolidNode& node = P.nodes[at];
      if (!any(meets_box(p, node, P.origin) & (B)(p.sum < P.most))) continue;
      if (node.count) {
        for (int32_t i = node.first; i < node.first + node.count; ++i) add_solid(p, P.solids[i]);
        continue;
      }
      const bool below = P.origin[node.axis] < node.split;
      stack[depth++] = below ? node.first : at + 1;
      stack[depth++] = below ? at + 1 : node.first;
    }
    for (int l = 0; l < lanes; ++l) P.depth[first + l] = p.sum[l] < P.most ? p.sum[l] : P.most;
  }
}

}  // namespace LINPRIM_ISA

#define LINPRIM_JOIN_(a, b) a##b
#define LINPRIM_JOIN(a, b) LINPRIM_JOIN_(a, b)
SegmentKernel LINPRIM_JOIN(segment_kernel_, LINPRIM_ISA)() { return LINPRIM_ISA::segment_depths; }

}  // namespace linprim
