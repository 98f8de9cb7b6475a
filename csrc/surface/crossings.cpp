// Boxes around the faces, halved along the longest side of their middles; an edge goes down those that its box touches.
#include "surface/crossings.h"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "base/parallel.h"
#include "surface/face_normals.h"

namespace linprim {
namespace {

constexpr int64_t kLeaf = 4;  // faces in a leaf at most
constexpr int64_t kEdgesPerTask = 4096;

struct Box {
  Vector low{INFINITY, INFINITY, INFINITY}, high{-INFINITY, -INFINITY, -INFINITY};

  void take(const Vector& point) {
    for (int k = 0; k < 3; ++k) low[k] = std::min(low[k], point[k]), high[k] = std::max(high[k], point[k]);
  }
  bool touches(const Box& other) const {
    bool all = true;
    for (int k = 0; k < 3; ++k) all &= low[k] <= other.high[k] && other.low[k] <= high[k];
    return all;
  }
};

// Faces begin .. end - 1 of the order. Its first child is the next node, unless that is `after`, the next one that is
// not below it: a leaf.
struct FaceNode {
  Box box;
  int64_t begin, end;
  size_t after;
};

struct FaceTree {
  const int64_t* corner;
  const double* vertex;
  std::vector<int64_t> order;
  std::vector<FaceNode> nodes;

  FaceTree(int64_t faces, const int64_t* corner, const double* vertex) : corner(corner), vertex(vertex), order(faces) {
    std::iota(order.begin(), order.end(), int64_t(0));
    if (faces) build(0, faces);
  }

  Vector at(int64_t v) const { return {vertex[3 * v], vertex[3 * v + 1], vertex[3 * v + 2]}; }

  double middle(int64_t face, int axis) const {
    const int64_t* c = corner + 3 * face;
    return vertex[3 * c[0] + axis] + vertex[3 * c[1] + axis] + vertex[3 * c[2] + axis];
  }

  void build(int64_t begin, int64_t end) {
    const size_t at_node = nodes.size();
    nodes.push_back({{}, begin, end, 0});
    Box box;
    if (end - begin > kLeaf) {
      Box middles;
      for (int64_t i = begin; i < end; ++i)
        middles.take({middle(order[i], 0), middle(order[i], 1), middle(order[i], 2)});
      int axis = 0;
      for (int k = 1; k < 3; ++k)
        if (middles.high[k] - middles.low[k] > middles.high[axis] - middles.low[axis]) axis = k;
      const int64_t half = begin + (end - begin) / 2;
      std::nth_element(order.begin() + begin, order.begin() + half, order.begin() + end,
                       [&](int64_t a, int64_t b) { return middle(a, axis) < middle(b, axis); });
      const size_t first = nodes.size();
      build(begin, half);
      const size_t second = nodes.size();
      build(half, end);
      for (const size_t child : {first, second}) box.take(nodes[child].box.low), box.take(nodes[child].box.high);
    } else {
      for (int64_t i = begin; i < end; ++i)
        for (int k = 0; k < 3; ++k) box.take(at(corner[3 * order[i] + k]));
    }
    nodes[at_node].box = box;
    nodes[at_node].after = nodes.size();
  }
};

// Tells on which side of triangles points lie.
struct Sides {
  double largest = 0;  // coordinate

  static double length(const Vector& v) { return std::abs(v[0]) + std::abs(v[1]) + std::abs(v[2]); }

  // Six times the volume of a tetrahedron; 0 where rounding may have made its sign: eight roundings in the sum, as in
  // the error bound of Shewchuk 1997, and those of the coordinates themselves.
  double volume(const Vector& a, const Vector& b, const Vector& c, const Vector& d) const {
    constexpr double kRounding = 8 * 0x1p-53;
    const Vector u = minus(b, a), v = minus(c, a), w = minus(d, a);
    const double x = length(u), y = length(v), z = length(w), found = dot(cross(u, v), w);
    return std::abs(found) > kRounding * (x * y * z + largest * (x * y + y * z + z * x)) ? found : 0;
  }

  bool goes_through(const Vector& p, const Vector& q, const Vector& a, const Vector& b, const Vector& c) const {
    if (!(volume(a, b, c, p) * volume(a, b, c, q) < 0)) return false;
    const double one = volume(p, q, a, b), two = volume(p, q, b, c), three = volume(p, q, c, a);
    return (one > 0 && two > 0 && three > 0) || (one < 0 && two < 0 && three < 0);
  }
};

void find(const FaceTree& tree, const Sides& sides, const int64_t* end, int64_t edge, Crossings& found) {
  const Vector p = tree.at(end[0]), q = tree.at(end[1]);
  Box box;
  box.take(p), box.take(q);
  const size_t before = found.face.size();
  for (size_t n = 0; n < tree.nodes.size();) {
    const FaceNode& node = tree.nodes[n];
    if (!node.box.touches(box)) {
      n = node.after;
      continue;
    }
    if (++n < node.after) continue;
    for (int64_t i = node.begin; i < node.end; ++i) {
      const int64_t* c = tree.corner + 3 * tree.order[i];
      if (std::any_of(c, c + 3, [&](int64_t v) { return v == end[0] || v == end[1]; })) continue;
      if (sides.goes_through(p, q, tree.at(c[0]), tree.at(c[1]), tree.at(c[2]))) found.face.push_back(tree.order[i]);
    }
  }
  std::sort(found.face.begin() + int64_t(before), found.face.end());
  found.edge.resize(found.face.size(), edge);
}

}  // namespace

Crossings crossings(int64_t faces, const int64_t* corner, const double* vertex, int64_t edges, const int64_t* end) {
  const FaceTree tree(faces, corner, vertex);
  Sides sides;
  for (int64_t i = 0; i < 3 * faces; ++i)
    for (const double x : tree.at(corner[i])) sides.largest = std::max(sides.largest, std::abs(x));
  const int64_t tasks = (edges + kEdgesPerTask - 1) / kEdgesPerTask;
  std::vector<Crossings> found(tasks);
  parallel_for(tasks, [&](int64_t task, int) {
    for (int64_t e = task * kEdgesPerTask; e < std::min((task + 1) * kEdgesPerTask, edges); ++e)
      find(tree, sides, end + 2 * e, e, found[task]);
  });
  Crossings all;
  for (const Crossings& part : found) {
    all.face.insert(all.face.end(), part.face.begin(), part.face.end());
    all.edge.insert(all.edge.end(), part.edge.begin(), part.edge.end());
  }
  return all;
}

}  // namespace linprim
