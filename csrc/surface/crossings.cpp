// Bounding volume hierarchy (BVH) of the faces' boxes, split at the median along the longest side of the box of their
// middles. An edge descends into the nodes that its box touches. If there are few edges, faces near none of them are
// left out.
#include "surface/crossings.h"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "base/parallel.h"
#include "surface/face_normals.h"

namespace linprim {
namespace {

constexpr int64_t kLeaf = 4;     // boxes in a leaf at most
constexpr int kLevelsApart = 4;  // levels of the tree below which subtrees are built in parallel
constexpr int64_t kEdgesPerTask = 4096;
constexpr int64_t kFew = 8;  // edges are few if there are at least this many times as many faces

// Axis-aligned bounding box.
struct Box {
  Vector low{INFINITY, INFINITY, INFINITY}, high{-INFINITY, -INFINITY, -INFINITY};

  void take(const Vector& point) {
    for (int k = 0; k < 3; ++k) low[k] = std::min(low[k], point[k]), high[k] = std::max(high[k], point[k]);
  }
  void take(const Box& other) { take(other.low), take(other.high); }
  bool touches(const Box& other) const {
    bool all = true;
    for (int k = 0; k < 3; ++k) all &= low[k] <= other.high[k] && other.low[k] <= high[k];
    return all;
  }
};

// The boxes begin .. end - 1 of `BoxTree::order`.
struct Range {
  int64_t begin, end;
};

// A node with the boxes begin .. end - 1 of `BoxTree::order`. Nodes are in depth-first order: the first child of a node
// is the next node, and `after` is the next node that is not below it. A leaf has no node between itself and `after`.
struct Node {
  Box box;
  int64_t begin, end;
  size_t after;
};

// BVH of boxes. Its upper levels are built on one thread, the subtrees below in parallel.
struct BoxTree {
  const std::vector<Box>& boxes;
  std::vector<int64_t> order;
  std::vector<Node> nodes;

  explicit BoxTree(const std::vector<Box>& boxes) : boxes(boxes), order(boxes.size()) {
    std::iota(order.begin(), order.end(), int64_t(0));
    if (boxes.empty()) return;
    const Range all{0, int64_t(boxes.size())};
    std::vector<Range> parts;
    divide(all, kLevelsApart, parts);
    std::vector<std::vector<Node>> below(parts.size());
    parallel_for(int64_t(parts.size()), [&](int64_t part, int) { build(parts[part], below[part]); });
    size_t next = 0;
    join(all, kLevelsApart, below, next);
  }

  // Calls body(i) for the boxes in leaves that `box` touches, until body returns true. Returns whether it did.
  template <class Body>
  bool any(const Box& box, const Body& body) const {
    for (size_t n = 0; n < nodes.size();) {
      const Node& node = nodes[n];
      if (!node.box.touches(box)) {
        n = node.after;
        continue;
      }
      if (++n < node.after) continue;
      for (int64_t i = node.begin; i < node.end; ++i)
        if (body(order[i])) return true;
    }
    return false;
  }

 private:
  // Returns twice the middle of a box along an axis.
  double middle(int64_t i, int axis) const { return boxes[i].low[axis] + boxes[i].high[axis]; }

  // Partitions a range at the median of the middles. Returns the beginning of the second half.
  int64_t halved(Range range) {
    Vector low{INFINITY, INFINITY, INFINITY}, high{-INFINITY, -INFINITY, -INFINITY};
    for (int64_t i = range.begin; i < range.end; ++i)
      for (int k = 0; k < 3; ++k) {
        const double at = middle(order[i], k);
        low[k] = std::min(low[k], at), high[k] = std::max(high[k], at);
      }
    int axis = 0;
    for (int k = 1; k < 3; ++k)
      if (high[k] - low[k] > high[axis] - low[axis]) axis = k;
    const int64_t half = range.begin + (range.end - range.begin) / 2;
    std::nth_element(order.begin() + range.begin, order.begin() + half, order.begin() + range.end,
                     [&](int64_t a, int64_t b) { return middle(a, axis) < middle(b, axis); });
    return half;
  }

  // Collects the ranges `levels` levels below, whose subtrees are built separately.
  void divide(Range range, int levels, std::vector<Range>& parts) {
    if (levels == 0 || range.end - range.begin <= kLeaf) return parts.push_back(range);
    const int64_t half = halved(range);
    divide({range.begin, half}, levels - 1, parts);
    divide({half, range.end}, levels - 1, parts);
  }

  // Assembles the tree of a range from its upper `levels` levels and the subtrees `below`, from subtree `next` on.
  void join(Range range, int levels, const std::vector<std::vector<Node>>& below, size_t& next) {
    const size_t first = nodes.size();
    if (levels == 0 || range.end - range.begin <= kLeaf) {
      for (Node node : below[next++]) node.after += first, nodes.push_back(node);
      return;
    }
    nodes.push_back({{}, range.begin, range.end, 0});
    const int64_t half = range.begin + (range.end - range.begin) / 2;
    join({range.begin, half}, levels - 1, below, next);
    const size_t second = nodes.size();
    join({half, range.end}, levels - 1, below, next);
    close(nodes, first, second);
  }

  // Appends the subtree of a range to `into`.
  void build(Range range, std::vector<Node>& into) {
    const size_t first = into.size();
    into.push_back({{}, range.begin, range.end, first + 1});
    if (range.end - range.begin <= kLeaf) {
      for (int64_t i = range.begin; i < range.end; ++i) into[first].box.take(boxes[order[i]]);
      return;
    }
    const int64_t half = halved(range);
    build({range.begin, half}, into);
    const size_t second = into.size();
    build({half, range.end}, into);
    close(into, first, second);
  }

  // Completes a node whose children are the next node and `second`, and whose subtree ends at the end of `tree`: sets
  // its box and `after`.
  static void close(std::vector<Node>& tree, size_t node, size_t second) {
    for (const size_t child : {node + 1, second}) tree[node].box.take(tree[child].box);
    tree[node].after = tree.size();
  }
};

// Orientation tests by signed volumes, with bounds on rounding.
struct Sides {
  double largest = 0;  // absolute coordinate of a vertex

  // Returns the 1-norm, which is at least the length.
  static double length(const Vector& v) { return std::abs(v[0]) + std::abs(v[1]) + std::abs(v[2]); }

  // Returns six times the signed volume of a tetrahedron, or 0 if rounding may have changed its sign. The bound covers
  // eight roundings in the sum, as in the error bound of Shewchuk 1997, and those of the coordinates themselves.
  double volume(const Vector& a, const Vector& b, const Vector& c, const Vector& d) const {
    constexpr double kRounding = 8 * 0x1p-53;
    const Vector u = minus(b, a), v = minus(c, a), w = minus(d, a);
    const double x = length(u), y = length(v), z = length(w), found = dot(cross(u, v), w);
    return std::abs(found) > kRounding * (x * y * z + largest * (x * y + y * z + z * x)) ? found : 0;
  }

  // Returns whether the segment p q pierces the triangle a b c.
  bool goes_through(const Vector& p, const Vector& q, const Vector& a, const Vector& b, const Vector& c) const {
    if (!(volume(a, b, c, p) * volume(a, b, c, q) < 0)) return false;
    const double one = volume(p, q, a, b), two = volume(p, q, b, c), three = volume(p, q, c, a);
    return (one > 0 && two > 0 && three > 0) || (one < 0 && two < 0 && three < 0);
  }
};

struct Triangles {
  const int64_t* corner;
  const double* vertex;

  Vector at(int64_t v) const { return {vertex[3 * v], vertex[3 * v + 1], vertex[3 * v + 2]}; }

  // Returns the bounding box of `count` vertices.
  Box around(const int64_t* v, int count) const {
    Box box;
    for (int k = 0; k < count; ++k) box.take(at(v[k]));
    return box;
  }
};

// Returns the boxes of `count` elements with `corners` vertices each.
std::vector<Box> boxes_around(const Triangles& mesh, int64_t count, const int64_t* corner, int corners) {
  std::vector<Box> boxes(count);
  for_rows(count, [&](int64_t i) { boxes[i] = mesh.around(corner + corners * i, corners); });
  return boxes;
}

// Returns the faces whose boxes touch the box of an edge, and reduces `boxes` to theirs.
std::vector<int64_t> near_edges(std::vector<Box>& boxes, const std::vector<Box>& edges) {
  const BoxTree tree(edges);
  std::vector<uint8_t> near(boxes.size());
  for_rows(int64_t(boxes.size()),
           [&](int64_t f) { near[f] = tree.any(boxes[f], [&](int64_t e) { return edges[e].touches(boxes[f]); }); });
  std::vector<int64_t> kept;
  for (size_t f = 0; f < boxes.size(); ++f)
    if (near[f]) boxes[kept.size()] = boxes[f], kept.push_back(int64_t(f));
  boxes.resize(kept.size());
  return kept;
}

// Appends the faces that an edge pierces to `found`, sorted.
void find(const Triangles& mesh, const std::vector<int64_t>& faces, const BoxTree& tree, const Sides& sides,
          const int64_t* end, int64_t edge, Crossings& found) {
  const Vector p = mesh.at(end[0]), q = mesh.at(end[1]);
  const size_t before = found.face.size();
  tree.any(mesh.around(end, 2), [&](int64_t i) {
    const int64_t* c = mesh.corner + 3 * faces[i];
    if (std::none_of(c, c + 3, [&](int64_t v) { return v == end[0] || v == end[1]; }) &&
        sides.goes_through(p, q, mesh.at(c[0]), mesh.at(c[1]), mesh.at(c[2])))
      found.face.push_back(faces[i]);
    return false;
  });
  std::sort(found.face.begin() + int64_t(before), found.face.end());
  found.edge.resize(found.face.size(), edge);
}

}  // namespace

Crossings crossings(int64_t vertices, const double* vertex, int64_t faces, const int64_t* corner, int64_t edges,
                    const int64_t* end) {
  const Triangles mesh{corner, vertex};
  std::vector<Box> boxes = boxes_around(mesh, faces, corner, 3);
  std::vector<int64_t> kept;
  if (kFew * edges <= faces) {
    kept = near_edges(boxes, boxes_around(mesh, edges, end, 2));
  } else {
    kept.resize(faces), std::iota(kept.begin(), kept.end(), int64_t(0));
  }
  const BoxTree tree(boxes);
  Sides sides;
  for (int64_t i = 0; i < 3 * vertices; ++i) sides.largest = std::max(sides.largest, std::abs(vertex[i]));
  const int64_t tasks = (edges + kEdgesPerTask - 1) / kEdgesPerTask;
  std::vector<Crossings> found(tasks);
  parallel_for(tasks, [&](int64_t task, int) {
    for (int64_t e = task * kEdgesPerTask; e < std::min((task + 1) * kEdgesPerTask, edges); ++e)
      find(mesh, kept, tree, sides, end + 2 * e, e, found[task]);
  });
  Crossings all;
  for (const Crossings& part : found) {
    all.face.insert(all.face.end(), part.face.begin(), part.face.end());
    all.edge.insert(all.edge.end(), part.edge.begin(), part.edge.end());
  }
  return all;
}

}  // namespace linprim
