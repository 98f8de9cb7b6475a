// Optical depth along straight segments from one point to many, through homogeneous polyhedra, in closed form with
// overlaps included.
#pragma once

#include <cstdint>
#include <vector>

#include "base/types.h"

namespace linprim {

struct SlabSolid {
  double center[3];
  Slabs slabs;
  double density;
};

// The same relative to a point: x is inside where |at + normal . (x - point)| <= 1 for all four slabs.
struct SeenSolid {
  double normal[4][3], at[4], density;
};

// A node of the bounding box hierarchy. Inner node (count 0): one child is the next node, the other is `first`, and the
// solids of the next node lie below `split` along `axis`. Leaf: solids first .. first + count - 1.
struct SolidNode {
  double low[3], high[3], split;
  int32_t first, count, axis;
};

struct SegmentParams {
  const SeenSolid* solids;
  const SolidNode* nodes;  // the root first
  const double* origin;    // 3
  const double* ends;      // (count, 3)
  const double* begin;     // (count) fraction of the way from the origin at which a segment begins, or null for 0
  double most;             // upper limit of the sums
  double* depth;           // (count)
};

// Bounding box hierarchy of the absorbing primitives, for optical depths along many segments. Primitives whose extent
// or density is not positive are left out; other extreme ones are clamped to the bounds of primitive_pose.h. No
// Gaussians.
class SolidTree {
 public:
  template <class Real>
  SolidTree(PrimitiveKind kind, int64_t n, const Real* center, const Real* rotation, const Real* extent,
            const Real* density);

  // depth[i] = min(most, sum over solids of density times the length of the segment inside). The segment runs from
  // origin + begin[i] (ends[i] - origin) to ends[i]. It is many times faster if neighbours in `ends` are close. A value
  // depends neither on the other ends nor on the number of threads.
  void optical_depth(const double* origin, const double* ends, const double* begin, int64_t count, double most,
                     double* depth) const;

  int64_t size() const { return int64_t(solids_.size()); }

 private:
  std::vector<SlabSolid> solids_;
  std::vector<SolidNode> nodes_;
};

// segment_kernel.cpp, once per instruction set: segments [begin, end).
using SegmentKernel = void (*)(const SegmentParams&, int64_t begin, int64_t end);
SegmentKernel segment_kernel_scalar();
#if defined(__x86_64__) || defined(_M_X64)
SegmentKernel segment_kernel_v2();
SegmentKernel segment_kernel_v3();
SegmentKernel segment_kernel_v4();
#else
SegmentKernel segment_kernel_neon();
#endif

}  // namespace linprim
