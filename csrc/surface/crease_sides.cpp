#include "surface/crease_sides.h"

#include <algorithm>
#include <cmath>
#include <memory>

#include "base/parallel.h"
#include "surface/face_normals.h"

namespace linprim {
namespace {

// Largest number of sides around an edge; least number of faces of a side; rounds of assigning faces to sides.
constexpr int kMostSides = 6, kLeastFaces = 3, kSideRounds = 3;
constexpr int64_t kEdgesPerTask = 512;
// Squared sine of the angle between two planes below which they are too close to parallel to intersect in a line.
constexpr double kLeastSine = 0.05;
// Relative bound on what rounding changes in a squared distance between normals.
constexpr double kRounding = 1e-9;

// A list of row numbers for each of many elements.
struct Lists {
  std::vector<int64_t> first, end;
  std::vector<int32_t> row;

  // Makes the lists of `count` elements. fill(i, next) writes the rows of element i from `next` on, at most most(i),
  // and returns their end. Lists are sorted and without duplicates.
  template <class Most, class Fill>
  void make(int64_t count, const Most& most, const Fill& fill) {
    first.resize(count), end.resize(count);
    int64_t total = 0;
    for (int64_t i = 0; i < count; ++i) first[i] = total, total += most(i);
    row.resize(total);
    for_rows(count, [&](int64_t i) {
      int32_t* const begin = row.data() + first[i];
      int32_t* const last = fill(i, begin);
      std::sort(begin, last);
      end[i] = std::unique(begin, last) - row.data();
    });
  }

  // Calls body(row) for each row in the list of element i.
  template <class Body>
  void each(int64_t i, const Body& body) const {
    for (int64_t k = first[i]; k < end[i]; ++k) body(int64_t(row[k]));
  }
};

// The mesh, with data per face and per vertex that all edges share.
struct Mesh {
  const FaceFans& fans;
  const double* vertex;
  FaceNormals faces;
  std::vector<Vector> averaged, middle;  // averaged normals; centroids
  std::vector<uint8_t> flat, inner;      // inner: the face and all around it are flat
  std::vector<double> edge;              // length of the second longest edge
  // Per inner face: the inner faces with lower numbers that share a vertex with it and whose averaged normals have a
  // cosine of at least `flat` to its own.
  Lists joined;
  Lists beside;  // per vertex: the vertices that it shares an edge with
  Lists inside;  // per vertex: the inner faces around it

  Vector at(int64_t v) const { return {vertex[3 * v], vertex[3 * v + 1], vertex[3 * v + 2]}; }
};

// A side: its plane has the weighted mean normal of its faces and goes through their weighted mean centroid.
struct Side {
  int part;  // connected component of its faces
  Vector normal, middle;
  double weight = 0;
  int faces = 0;
};

// Returns the length of the second longest edge of a face.
double middle_edge(const Mesh& mesh, int64_t face) {
  const int64_t* corner = mesh.fans.corner + 3 * face;
  double length[3];
  for (int k = 0; k < 3; ++k) {
    const Vector along = minus(mesh.at(corner[k]), mesh.at(corner[(k + 1) % 3]));
    length[k] = std::sqrt(dot(along, along));
  }
  return std::max(std::min(length[0], length[1]), std::min(std::max(length[0], length[1]), length[2]));
}

// Fills the lists of the mesh.
void find_lists(const CreaseRules& how, Mesh& mesh) {
  const FaceFans& fans = mesh.fans;
  const auto around = [&](int64_t v) { return fans.first[v + 1] - fans.first[v]; };
  mesh.joined.make(
      fans.faces,
      [&](int64_t f) {
        const int64_t* corner = fans.corner + 3 * f;
        return mesh.inner[f] ? around(corner[0]) + around(corner[1]) + around(corner[2]) : 0;
      },
      [&](int64_t f, int32_t* next) {
        if (!mesh.inner[f]) return next;
        fans.around(f, [&](int64_t g) {
          if (g < f && mesh.inner[g] && dot(mesh.averaged[f], mesh.averaged[g]) >= how.flat) *next++ = int32_t(g);
        });
        return next;
      });
  mesh.beside.make(
      fans.vertices, [&](int64_t v) { return 2 * around(v); },
      [&](int64_t v, int32_t* next) {
        for (int64_t i = fans.first[v]; i < fans.first[v + 1]; ++i)
          for (int k = 0; k < 3; ++k) {
            const int64_t other = fans.corner[3 * fans.face[i] + k];
            if (other != v) *next++ = int32_t(other);
          }
        return next;
      });
  mesh.inside.make(fans.vertices, around, [&](int64_t v, int32_t* next) {
    for (int64_t i = fans.first[v]; i < fans.first[v + 1]; ++i)
      if (mesh.inner[fans.face[i]]) *next++ = int32_t(fans.face[i]);
    return next;
  });
}

// Computes the data of the mesh that all edges share.
Mesh prepared(const CreaseRules& how, const FaceFans& fans, const double* vertex) {
  Mesh mesh{fans, vertex, face_normals(fans, vertex), {}, {}, {}, {}, {}, {}, {}, {}};
  mesh.averaged = average_normals(fans, mesh.faces, how.contrast, how.normal_rounds);
  mesh.middle.resize(fans.faces), mesh.flat.resize(fans.faces), mesh.inner.resize(fans.faces);
  mesh.edge.resize(fans.faces);
  for_rows(fans.faces, [&](int64_t f) {
    Vector& middle = mesh.middle[f];
    middle = {};
    for (int k = 0; k < 3; ++k) add(middle, 1.0 / 3, mesh.at(fans.corner[3 * f + k]));
    double least = 1;
    fans.around(f, [&](int64_t g) { least = std::min(least, dot(mesh.averaged[f], mesh.averaged[g])); });
    mesh.flat[f] = least >= how.flat && mesh.faces.area[f] > 0;
    mesh.edge[f] = middle_edge(mesh, f);
  });
  for_rows(fans.faces, [&](int64_t f) {
    uint8_t all = 1;
    fans.around(f, [&](int64_t g) { all &= mesh.flat[g]; });
    mesh.inner[f] = all;
  });
  find_lists(how, mesh);
  return mesh;
}

// Axis-aligned bounding box of normals.
struct Box {
  Vector low{INFINITY, INFINITY, INFINITY}, high{-INFINITY, -INFINITY, -INFINITY};

  void take(const Box& other) {
    for (int axis = 0; axis < 3; ++axis) {
      low[axis] = std::min(low[axis], other.low[axis]);
      high[axis] = std::max(high[axis], other.high[axis]);
    }
  }
};

// Returns for each vertex the bounding box of the averaged normals of all inner faces within `rings` rings around it.
std::vector<Box> boxes_of_normals(const CreaseRules& how, const Mesh& mesh) {
  std::vector<Box> box(mesh.fans.vertices), wider(mesh.fans.vertices);
  for_rows(mesh.fans.vertices, [&](int64_t v) {
    mesh.inside.each(v, [&](int64_t f) { box[v].take({mesh.averaged[f], mesh.averaged[f]}); });
  });
  for (int ring = 0; ring < how.rings; ++ring) {
    for_rows(mesh.fans.vertices, [&](int64_t v) {
      wider[v] = box[v];
      mesh.beside.each(v, [&](int64_t other) { wider[v].take(box[other]); });
    });
    box.swap(wider);
  }
  return box;
}

// Returns whether sides with normals in a box may meet at a crease. Unit vectors in the box, and so their means, differ
// by no more than its diagonal.
bool may_differ(const CreaseRules& how, const Box& box) {
  const Vector wide = minus(box.high, box.low);
  return box.low[0] <= box.high[0] && dot(wide, wide) >= (1 - kRounding) * (2 - 2 * how.crease);
}

// Tests one edge after the other for sides around it. Each thread has an instance with its own scratch memory.
class Around {
 public:
  Around(const CreaseRules& how, const Mesh& mesh)
      : how_(how), mesh_(mesh), place_(mesh.fans.faces), reached_(mesh.fans.vertices) {}

  // Writes the planes of the sides of an edge's ends, whether the two sides meet at a crease, and the median length of
  // the edges around. Returns false if an end has no side, if the normals of a side are not even, or if the ends lie on
  // different sides that do not make a crease.
  bool test(const int64_t* ends, double* plane, uint8_t& crosses, double& length) {
    if (!gather(ends)) return false;
    measure();
    length = length_;
    const Vector end[2] = {mesh_.at(ends[0]), mesh_.at(ends[1])};
    for (int axis = 0; axis < 3; ++axis) here_[axis] = 0.5 * (end[0][axis] + end[1][axis]);
    if (!find_sides()) return false;
    const Side* own[2];
    for (int j = 0; j < 2; ++j)
      if (!(own[j] = nearest(end[j])) || !even(*own[j])) return false;
    for (int j = 0; j < 2; ++j) {
      std::copy_n(own[j]->normal.data(), 3, plane + 4 * j);
      plane[4 * j + 3] = dot(own[j]->normal, own[j]->middle);
    }
    crosses = own[0] != own[1] && make_crease(*own[0], *own[1]);
    return own[0] == own[1] || crosses;
  }

 private:
  // Collects the inner faces within the rings around the edge, and their connected components by union-find. Returns
  // false if they are too few for a side.
  bool gather(const int64_t* ends) {
    ++now_;
    vertices_.clear(), faces_.clear(), parent_.clear();
    const auto visit = [&](int64_t v) {
      if (reached_[v] == now_) return;
      reached_[v] = now_, vertices_.push_back(v);
    };
    visit(ends[0]), visit(ends[1]);
    size_t begin = 0;
    for (int ring = 0; ring < how_.rings; ++ring) {
      const size_t end = vertices_.size();
      for (size_t q = begin; q < end; ++q) mesh_.beside.each(vertices_[q], visit);
      begin = end;
    }
    for (const int64_t v : vertices_)
      mesh_.inside.each(v, [&](int64_t f) {
        if (place_[f].reached == now_) return;
        place_[f].reached = now_, place_[f].row = int(faces_.size());
        parent_.push_back(int(faces_.size())), faces_.push_back(f);
      });
    if (faces_.size() < kLeastFaces) return false;
    for (size_t i = 0; i < faces_.size(); ++i)
      mesh_.joined.each(faces_[i], [&](int64_t g) {
        if (place_[g].reached == now_) parent_[root(int(i))] = root(place_[g].row);
      });
    part_.resize(faces_.size());
    for (size_t i = 0; i < faces_.size(); ++i) part_[i] = root(int(i));
    return true;
  }

  // Computes the median of the second longest edges of the faces around.
  void measure() {
    lengths_.clear();
    for (const int64_t v : vertices_)
      for (int64_t i = mesh_.fans.first[v]; i < mesh_.fans.first[v + 1]; ++i) {
        const int64_t f = mesh_.fans.face[i];
        if (place_[f].measured == now_) continue;
        place_[f].measured = now_, lengths_.push_back(mesh_.edge[f]);
      }
    const auto middle = lengths_.begin() + int64_t(lengths_.size() / 2);
    std::nth_element(lengths_.begin(), middle, lengths_.end());
    length_ = *middle;
  }

  // Returns the root of a face in the union-find forest.
  int root(int i) {
    while (parent_[i] != i) i = parent_[i] = parent_[parent_[i]];
    return i;
  }

  // Splits the connected components into sides where normals differ. Each side starts from the face with the most
  // weight that no side has claimed; then rounds assign every face to the side of its component with the nearest
  // normal, and average. Returns false if there are too many sides.
  bool find_sides() {
    const int count = int(faces_.size());
    weight_.resize(count), side_.resize(count), claimed_.assign(count, 0);
    for (int i = 0; i < count; ++i) {
      const Vector away = minus(mesh_.middle[faces_[i]], here_);
      const double far = std::max(0.0, std::sqrt(dot(away, away)) / length_ - 1) / how_.falloff;
      weight_[i] = mesh_.faces.area[faces_[i]] * std::exp(-0.5 * far * far);
    }
    sides_.clear();
    for (int next; (next = heaviest()) >= 0;) {
      if (sides_.size() == kMostSides) return false;
      const Side side{part_[next], mesh_.averaged[faces_[next]], {}};
      sides_.push_back(side);
      for (int i = 0; i < count; ++i)
        claimed_[i] |= i == next || (part_[i] == side.part && dot(side.normal, mesh_.averaged[faces_[i]]) > how_.side);
    }
    for (int round = 0; round < kSideRounds; ++round) {
      std::vector<Side> sums(sides_.size());
      for (int i = 0; i < count; ++i) {
        const Vector& normal = mesh_.averaged[faces_[i]];
        double most = -2;
        for (size_t k = 0; k < sides_.size(); ++k)
          if (sides_[k].part == part_[i] && dot(sides_[k].normal, normal) > most)
            most = dot(sides_[k].normal, normal), side_[i] = int(k);
        Side& sum = sums[side_[i]];
        add(sum.normal, weight_[i], normal), add(sum.middle, weight_[i], mesh_.middle[faces_[i]]);
        sum.weight += weight_[i], ++sum.faces;
      }
      for (size_t k = 0; k < sides_.size(); ++k) {
        if (!(sums[k].weight > 0 && normalize(sums[k].normal) > 0)) sums[k].normal = sides_[k].normal;
        if (sums[k].weight > 0)
          for (double& x : sums[k].middle) x /= sums[k].weight;
        sums[k].part = sides_[k].part, sides_[k] = sums[k];
      }
    }
    return true;
  }

  // Returns the face with the most weight that no side has claimed, the first of equal ones; -1 if there is none.
  int heaviest() const {
    int best = -1;
    for (int i = 0; i < int(weight_.size()); ++i)
      if (!claimed_[i] && (best < 0 || weight_[i] > weight_[best])) best = i;
    return best;
  }

  // Returns the side with the nearest plane to a point, of those with enough faces; null if there is none.
  const Side* nearest(const Vector& point) const {
    const Side* best = nullptr;
    double least = INFINITY;
    for (const Side& side : sides_) {
      const double far = std::abs(dot(minus(point, side.middle), side.normal));
      if (side.faces >= kLeastFaces && side.weight > 0 && far < least) least = far, best = &side;
    }
    return best;
  }

  // Returns whether the mean cosine between the normals of a side's faces and its own is at least `even`.
  bool even(const Side& side) const {
    double mean = 0;
    for (size_t i = 0; i < faces_.size(); ++i)
      if (&sides_[side_[i]] == &side) mean += weight_[i] * dot(side.normal, mesh_.averaged[faces_[i]]);
    return mean >= how_.even * side.weight;
  }

  // Returns whether the normals of two sides differ enough for a crease, both in the mean and extrapolated to the edge.
  bool make_crease(const Side& a, const Side& b) const {
    const double cosine = dot(a.normal, b.normal);
    if (cosine > how_.crease || 1 - cosine * cosine < kLeastSine) return false;
    Vector one, other;
    return goes_on(a, one) && goes_on(b, other) && dot(one, other) <= how_.crease;
  }

  // Extrapolates the normal of a side to the edge, by a linear fit to the mesh's own face normals. Returns false if the
  // side is not wide enough.
  bool goes_on(const Side& side, Vector& normal) const {
    Vector across = minus(here_, side.middle);
    add(across, -dot(across, side.normal), side.normal);
    const double reach = normalize(across);
    double low = INFINITY, high = -INFINITY, squares = 0;
    Vector mean{}, turn{};
    for (size_t i = 0; i < faces_.size(); ++i) {
      if (&sides_[side_[i]] != &side) continue;
      const double x = dot(minus(mesh_.middle[faces_[i]], side.middle), across);
      const Vector& own = mesh_.faces.normal[faces_[i]];
      low = std::min(low, x), high = std::max(high, x), squares += weight_[i] * x * x;
      add(mean, weight_[i], own), add(turn, weight_[i] * x, own);
    }
    if (!(high - low >= how_.wide * length_ && squares > 0)) return false;
    normal = {};
    add(normal, 1 / side.weight, mean), add(normal, reach / squares, turn);
    normalize(normal);
    return true;
  }

  const CreaseRules& how_;
  const Mesh& mesh_;
  struct Place {
    int reached = 0, row = 0, measured = 0;
  };
  // Per face of the mesh: the test (`now_`) in which it was last reached, its row in `faces_` then, and the test in
  // which it was last measured. Per vertex: the test in which it was last reached.
  std::vector<Place> place_;
  std::vector<int> reached_;
  int now_ = 0;
  std::vector<int64_t> vertices_, faces_;
  std::vector<int> parent_, part_, side_;  // per row of `faces_`, as are `claimed_` and `weight_`
  std::vector<uint8_t> claimed_;
  std::vector<double> weight_, lengths_;
  double length_ = 0;
  std::vector<Side> sides_;
  Vector here_;
};

using Ends = std::array<int64_t, 2>;

// Returns the edges of faces that are not flat, each once, sorted.
std::vector<Ends> edges_to_test(const Mesh& mesh) {
  std::vector<Ends> edges;
  for (int64_t f = 0; f < mesh.fans.faces; ++f)
    for (int k = 0; k < 3 && !mesh.flat[f]; ++k) {
      const int64_t a = mesh.fans.corner[3 * f + k], b = mesh.fans.corner[3 * f + (k + 1) % 3];
      edges.push_back({std::min(a, b), std::max(a, b)});
    }
  std::sort(edges.begin(), edges.end());
  edges.erase(std::unique(edges.begin(), edges.end()), edges.end());
  return edges;
}

// Results of the tests, one entry per edge; `known`: both ends lie on known sides.
struct EdgeTests {
  std::vector<std::array<double, 8>> plane;
  std::vector<uint8_t> known, crosses, tested;
  std::vector<double> length;

  explicit EdgeTests(size_t count) : plane(count), known(count), crosses(count), tested(count), length(count) {}
};

// Marks the vertices of all faces that touch an end of an edge across a crease.
std::vector<uint8_t> beside_creases(const Mesh& mesh, const std::vector<Ends>& edges, const EdgeTests& tests) {
  std::vector<uint8_t> end(mesh.fans.vertices), beside(mesh.fans.vertices);
  for (size_t e = 0; e < edges.size(); ++e)
    if (tests.known[e] && tests.crosses[e]) end[edges[e][0]] = end[edges[e][1]] = 1;
  for_rows(mesh.fans.vertices, [&](int64_t v) {
    beside[v] = end[v];
    mesh.beside.each(v, [&](int64_t other) { beside[v] |= end[other]; });
  });
  return beside;
}

}  // namespace

CreaseEdges crease_edges(const CreaseRules& how, int64_t vertices, int64_t faces, const int64_t* corner,
                         const double* vertex) {
  const FaceFans fans(vertices, faces, corner);
  const Mesh mesh = prepared(how, fans, vertex);
  const std::vector<Ends> edges = edges_to_test(mesh);
  const int64_t count = int64_t(edges.size());
  EdgeTests tests(edges.size());
  std::vector<std::unique_ptr<Around>> around(threads());
  // Tests the edges for which wanted(ends) is true and which were not tested before.
  const auto test_where = [&](const auto& wanted) {
    parallel_for((count + kEdgesPerTask - 1) / kEdgesPerTask, [&](int64_t task, int thread) {
      if (!around[thread]) around[thread] = std::make_unique<Around>(how, mesh);
      for (int64_t e = task * kEdgesPerTask; e < std::min((task + 1) * kEdgesPerTask, count); ++e) {
        if (tests.tested[e] || !wanted(edges[e])) continue;
        tests.tested[e] = 1;
        tests.known[e] =
            around[thread]->test(edges[e].data(), tests.plane[e].data(), tests.crosses[e], tests.length[e]);
      }
    });
  };
  const std::vector<Box> boxes = boxes_of_normals(how, mesh);
  test_where([&](const Ends& end) {
    Box box = boxes[end[0]];
    box.take(boxes[end[1]]);
    return may_differ(how, box);
  });
  const std::vector<uint8_t> beside = beside_creases(mesh, edges, tests);
  test_where([&](const Ends& end) { return beside[end[0]] || beside[end[1]]; });
  CreaseEdges out;
  for (int64_t e = 0; e < count; ++e) {
    if (!tests.known[e] || !(beside[edges[e][0]] || beside[edges[e][1]])) continue;
    out.end.insert(out.end.end(), edges[e].begin(), edges[e].end());
    out.plane.insert(out.plane.end(), tests.plane[e].begin(), tests.plane[e].end());
    out.crosses.push_back(tests.crosses[e]);
    out.length.push_back(tests.length[e]);
  }
  return out;
}

}  // namespace linprim
