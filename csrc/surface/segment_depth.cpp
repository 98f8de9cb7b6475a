// Builds the bounding box hierarchy for optical depths of segments by median splits, and runs the traversal kernel of
// the instruction set in use.
#include "surface/segment_depth.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <numeric>

#include "base/copies.h"
#include "base/parallel.h"

namespace linprim {
namespace {

constexpr int64_t kLeaf = 4;  // solids in a leaf at most
constexpr int64_t kSegmentsPerTask = 512;
// Limits of density and extent, as in primitive_pose.h.
constexpr double kLargestDensity = 1e20, kSmallestExtent = 1e-15, kLargestExtent = 1e12;

// Axis-aligned bounding box.
struct Box {
  std::array<double, 3> low, high;
};

// Computes the rotation matrix of a quaternion of any length; (0, 0, 0, 0) is no rotation. Columns are the local axes
// in the world.
void rotation_matrix(const double q_raw[4], double r[3][3]) {
  double scale = 0, q[4];
  for (int k = 0; k < 4; ++k) scale = std::max(scale, std::abs(q_raw[k]));
  double length2 = 0;
  for (int k = 0; k < 4; ++k) {
    q[k] = scale > 0 ? q_raw[k] / scale : (k == 0 ? 1.0 : 0.0);
    length2 += q[k] * q[k];
  }
  for (double& x : q) x /= std::sqrt(length2);
  const double a = q[0], x = q[1], y = q[2], z = q[3];
  const double m[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y - a * z), 2 * (x * z + a * y)},
                          {2 * (x * y + a * z), 1 - 2 * (x * x + z * z), 2 * (y * z - a * x)},
                          {2 * (x * z - a * y), 2 * (y * z + a * x), 1 - 2 * (x * x + y * y)}};
  std::memcpy(r, m, sizeof m);
}

// Appends nodes in depth-first order, and solids in the order of the leaves.
struct Builder {
  const std::vector<Box>& boxes;
  const std::vector<SlabSolid>& from;
  std::vector<int32_t> order;
  std::vector<SlabSolid>& solids;
  std::vector<SolidNode>& nodes;

  // Builds the subtree of the solids begin .. end - 1 of `order`, split at the median of their centres along the axis
  // in which these extend farthest.
  void build(int64_t begin, int64_t end) {
    const size_t at = nodes.size();
    nodes.emplace_back();
    SolidNode node{};
    Box middles;
    for (int k = 0; k < 3; ++k) {
      node.low[k] = middles.low[k] = std::numeric_limits<double>::infinity();
      node.high[k] = middles.high[k] = -node.low[k];
      for (int64_t i = begin; i < end; ++i) {
        const Box& box = boxes[order[i]];
        node.low[k] = std::min(node.low[k], box.low[k]), node.high[k] = std::max(node.high[k], box.high[k]);
        const double middle = from[order[i]].center[k];
        middles.low[k] = std::min(middles.low[k], middle), middles.high[k] = std::max(middles.high[k], middle);
      }
      if (middles.high[k] - middles.low[k] > middles.high[node.axis] - middles.low[node.axis]) node.axis = k;
    }
    if (end - begin <= kLeaf) {
      node.first = int32_t(solids.size()), node.count = int32_t(end - begin);
      std::sort(order.begin() + begin, order.begin() + end);
      for (int64_t i = begin; i < end; ++i) solids.push_back(from[order[i]]);
      nodes[at] = node;
      return;
    }
    const int64_t middle = begin + (end - begin) / 2;
    const int axis = node.axis;
    std::nth_element(order.begin() + begin, order.begin() + middle, order.begin() + end, [&](int32_t a, int32_t b) {
      const double x = from[a].center[axis], y = from[b].center[axis];
      return x < y || (x == y && a < b);
    });
    node.split = from[order[middle]].center[axis];
    build(begin, middle);
    node.first = int32_t(nodes.size());
    nodes[at] = node;
    build(middle, end);
  }
};

}  // namespace

template <class Real>
SolidTree::SolidTree(PrimitiveKind kind, int64_t n, const Real* center, const Real* rotation, const Real* extent,
                     const Real* density) {
  const KindTraits& traits = traits_of(kind);
  const int extents = traits.extents;
  std::vector<SlabSolid> from;
  std::vector<Box> boxes;
  for (int64_t i = 0; i < n; ++i) {
    bool absorbs = density[i] > 0;
    double e[4], q[4], r[3][3];
    for (int k = 0; k < extents; ++k) {
      absorbs = absorbs && extent[i * extents + k] > 0;
      e[k] = std::clamp(double(extent[i * extents + k]), kSmallestExtent, kLargestExtent);
    }
    if (!absorbs) continue;
    for (int k = 0; k < 4; ++k) q[k] = double(rotation[4 * i + k]);
    rotation_matrix(q, r);
    SlabSolid solid;
    Box box;
    traits.slabs(r, e, solid.slabs);
    for (int k = 0; k < 3; ++k) {
      solid.center[k] = double(center[3 * i + k]);
      box.low[k] = solid.center[k] + solid.slabs.low[k], box.high[k] = solid.center[k] + solid.slabs.high[k];
    }
    solid.density = std::min(double(density[i]), kLargestDensity);
    from.push_back(solid), boxes.push_back(box);
  }
  if (from.empty()) return;
  solids_.reserve(from.size());
  Builder builder{boxes, from, std::vector<int32_t>(from.size()), solids_, nodes_};
  std::iota(builder.order.begin(), builder.order.end(), 0);
  builder.build(0, int64_t(from.size()));
}
template SolidTree::SolidTree(PrimitiveKind, int64_t, const float*, const float*, const float*, const float*);
template SolidTree::SolidTree(PrimitiveKind, int64_t, const double*, const double*, const double*, const double*);

void SolidTree::optical_depth(const double* origin, const double* ends, const double* begin, int64_t count, double most,
                              double* depth) const {
  if (solids_.empty()) {
    std::fill(depth, depth + count, 0.0);
    return;
  }
  // The solids relative to the origin of all segments.
  std::vector<SeenSolid> seen(solids_.size());
  for (size_t i = 0; i < seen.size(); ++i) {
    const SlabSolid& from = solids_[i];
    std::memcpy(seen[i].normal, from.slabs.normal, sizeof from.slabs.normal);
    seen[i].density = from.density;
    for (int j = 0; j < 4; ++j) {
      seen[i].at[j] = from.slabs.shift[j];
      for (int k = 0; k < 3; ++k) seen[i].at[j] += from.slabs.normal[j][k] * (origin[k] - from.center[k]);
    }
  }
  const SegmentParams params{seen.data(), nodes_.data(), origin, ends, begin, most, depth};
  const SegmentKernel kernel = kernel_in_force<SegmentKernel>(LINPRIM_COPIES(segment_kernel));
  parallel_for((count + kSegmentsPerTask - 1) / kSegmentsPerTask, [&](int64_t task, int) {
    kernel(params, task * kSegmentsPerTask, std::min(count, (task + 1) * kSegmentsPerTask));
  });
}

}  // namespace linprim
