// Bounding box hierarchy of the points, split at the median along the longest side. A body descends into the boxes that
// are not entirely outside of one of its faces.
#include "surface/points_within.h"

#include <algorithm>
#include <numeric>

#include "base/parallel.h"

namespace linprim {
namespace {

constexpr int64_t kLeaf = 16;  // points in a leaf at most
constexpr int64_t kBodiesPerTask = 64;

// A node with the points begin .. end - 1 of `PointTree::order`. Nodes are in depth-first order: the first child of a
// node is the next node, and `after` is the next node that is not below it. A leaf has no node between itself and
// `after`.
struct PointNode {
  double low[3], high[3];
  int64_t begin, end;
  size_t after;
};

struct PointTree {
  const double* point;
  std::vector<int64_t> order;
  std::vector<PointNode> nodes;

  // Builds the subtree of a range of the order.
  void build(int64_t begin, int64_t end) {
    const size_t at = nodes.size();
    nodes.emplace_back();
    PointNode node{{}, {}, begin, end, 0};
    int axis = 0;
    for (int k = 0; k < 3; ++k) {
      node.low[k] = node.high[k] = point[3 * order[begin] + k];
      for (int64_t i = begin; i < end; ++i) {
        const double x = point[3 * order[i] + k];
        node.low[k] = std::min(node.low[k], x), node.high[k] = std::max(node.high[k], x);
      }
      if (node.high[k] - node.low[k] > node.high[axis] - node.low[axis]) axis = k;
    }
    if (end - begin > kLeaf) {
      const int64_t middle = begin + (end - begin) / 2;
      std::nth_element(order.begin() + begin, order.begin() + middle, order.begin() + end,
                       [&](int64_t a, int64_t b) { return point[3 * a + axis] < point[3 * b + axis]; });
      build(begin, middle);
      build(middle, end);
    }
    node.after = nodes.size();
    nodes[at] = node;
  }
};

// Returns the signed distance of x from the centre along the normal of a face. Monotonic in every coordinate, rounding
// included.
double ahead(const double* normal, const double* center, const double* x) {
  return normal[0] * (x[0] - center[0]) + normal[1] * (x[1] - center[1]) + normal[2] * (x[2] - center[2]);
}

// Returns the points within an enlarged body, sorted; none if fewer than `least` lie within the body before it is
// enlarged.
std::vector<int64_t> find(const PointTree& tree, const ConvexBodies& bodies, int64_t body, double enlarged,
                          int64_t least) {
  const double* center = bodies.center + 3 * body;
  const double* normal = bodies.normal + 3 * bodies.faces * body;
  const double* offset = bodies.offset + bodies.faces * body;
  std::vector<int64_t> found;
  int64_t inside = 0;
  for (size_t at = 0; at < tree.nodes.size();) {
    const PointNode& node = tree.nodes[at];
    bool outside = false;
    for (int f = 0; f < bodies.faces && !outside; ++f) {
      const double* n = normal + 3 * f;
      const double nearest[3] = {n[0] > 0 ? node.low[0] : node.high[0], n[1] > 0 ? node.low[1] : node.high[1],
                                 n[2] > 0 ? node.low[2] : node.high[2]};
      outside = ahead(n, center, nearest) > enlarged * offset[f];
    }
    const bool leaf = node.after == at + 1;
    for (int64_t i = node.begin; leaf && !outside && i < node.end; ++i) {
      bool within = true, inner = true;
      for (int f = 0; f < bodies.faces && within; ++f) {
        const double distance = ahead(normal + 3 * f, center, tree.point + 3 * tree.order[i]);
        within = distance <= enlarged * offset[f], inner = inner && distance <= offset[f];
      }
      if (within) found.push_back(tree.order[i]), inside += inner;
    }
    at = outside ? node.after : at + 1;
  }
  if (inside < least) found.clear();
  std::sort(found.begin(), found.end());
  return found;
}

}  // namespace

std::vector<std::vector<int64_t>> points_within(const ConvexBodies& bodies, const double* point, int64_t count,
                                                double enlarged, int64_t least) {
  PointTree tree{point, std::vector<int64_t>(count), {}};
  std::iota(tree.order.begin(), tree.order.end(), int64_t(0));
  if (count > 0) tree.build(0, count);
  std::vector<std::vector<int64_t>> found(bodies.count);
  parallel_for((bodies.count + kBodiesPerTask - 1) / kBodiesPerTask, [&](int64_t task, int) {
    const int64_t end = std::min((task + 1) * kBodiesPerTask, bodies.count);
    for (int64_t body = task * kBodiesPerTask; body < end; ++body)
      found[body] = find(tree, bodies, body, enlarged, least);
  });
  return found;
}

}  // namespace linprim
