#include "surface/simplify.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <queue>
#include <tuple>

#include "surface/face_normals.h"

namespace linprim {
namespace {

using Row = int32_t;

constexpr double kMostTurn = 0.5;  // least cosine of a face's turn in one collapse: beyond, it has folded over
constexpr double kSliver = 0.17364817766693;  // sine of 10 degrees: smaller angles may not become smaller still
// Weight of squared distances from the corners of the given faces, relative to squared distances from their planes: it
// spaces vertices out where all positions are equally good. This term pulls a vertex off the planes; each of the rounds
// reduces that to this share.
constexpr double kSpacing = 1e-3;
constexpr int kRounds = 3;
// A refused collapse may be allowed after changes around it: passes with a new queue are repeated as long as one
// removes more than this share of the faces.
constexpr double kWorthwhile = 0.01;

Vector plus(Vector a, double factor, const Vector& b) {
  add(a, factor, b);
  return a;
}

double squared(const Vector& a) { return dot(a, a); }

// Quadric error: weighted squared distances from planes, x A x - 2 b x + c with the upper triangle of A row by row, and
// from points.
struct Quadric {
  std::array<double, 6> a{};
  Vector b{}, points{};  // points: their weighted sum
  double c = 0, weight = 0, points_squared = 0;

  // Adds a point and the plane through it, with the weight `by`.
  void add_corner(double by, const Vector& normal, const Vector& point) {
    int k = 0;
    for (int i = 0; i < 3; ++i)
      for (int j = i; j < 3; ++j) a[k++] += by * normal[i] * normal[j];
    const double offset = dot(normal, point);
    add(b, by * offset, normal), add(points, by, point);
    c += by * offset * offset, points_squared += by * squared(point);
    weight += by;
  }

  void add_quadric(const Quadric& other) {
    for (int k = 0; k < 6; ++k) a[k] += other.a[k];
    add(b, 1, other.b), add(points, 1, other.points);
    c += other.c, points_squared += other.points_squared;
    weight += other.weight;
  }

  // Returns the error at x: from the planes, and kSpacing times that from the points.
  double at(const Vector& x) const {
    const Vector ax{a[0] * x[0] + a[1] * x[1] + a[2] * x[2], a[1] * x[0] + a[3] * x[1] + a[4] * x[2],
                    a[2] * x[0] + a[4] * x[1] + a[5] * x[2]};
    const double planes = dot(x, ax) - 2 * dot(b, x) + c;
    return planes + kSpacing * (weight * squared(x) - 2 * dot(points, x) + points_squared);
  }

  // Returns the position that is nearest to the planes and, of equally near ones, to the mean of the points.
  Vector nearest() const {
    Vector x{};
    add(x, 1 / weight, points);
    for (int round = 0; round < kRounds; ++round) x = nearer(x);
    return x;
  }

 private:
  // Minimises the squared distance from the planes plus that from x, which has the weight kSpacing.
  Vector nearer(const Vector& x) const {
    const double s = kSpacing * weight;
    const double a0 = a[0] + s, a3 = a[3] + s, a5 = a[5] + s;
    const double c0 = a3 * a5 - a[4] * a[4], c1 = a[2] * a[4] - a[1] * a5, c2 = a[1] * a[4] - a[2] * a3;
    const double c3 = a0 * a5 - a[2] * a[2], c4 = a[1] * a[2] - a0 * a[4], c5 = a0 * a3 - a[1] * a[1];
    const double determinant = a0 * c0 + a[1] * c1 + a[2] * c2;
    const Vector right{b[0] + s * x[0], b[1] + s * x[1], b[2] + s * x[2]};
    return {(c0 * right[0] + c1 * right[1] + c2 * right[2]) / determinant,
            (c1 * right[0] + c3 * right[1] + c4 * right[2]) / determinant,
            (c2 * right[0] + c4 * right[1] + c5 * right[2]) / determinant};
  }
};

double squared_distance_to_segment(const Vector& p, const Vector& a, const Vector& b) {
  const Vector along = minus(b, a), from = minus(p, a);
  const double length = squared(along), at = length > 0 ? std::clamp(dot(from, along) / length, 0.0, 1.0) : 0.0;
  return squared(plus(from, -at, along));
}

double squared_distance_to_triangle(const Vector& p, const std::array<Vector, 3>& t) {
  const Vector normal = cross(minus(t[1], t[0]), minus(t[2], t[0]));
  const double area = squared(normal);
  bool inside = area > 0;
  for (int k = 0; inside && k < 3; ++k) inside = dot(cross(minus(t[(k + 1) % 3], t[k]), minus(p, t[k])), normal) >= 0;
  if (inside) {
    const double height = dot(minus(p, t[0]), normal);
    return height * height / area;
  }
  double least = std::numeric_limits<double>::infinity();
  for (int k = 0; k < 3; ++k) least = std::min(least, squared_distance_to_segment(p, t[k], t[(k + 1) % 3]));
  return least;
}

// Returns the sine of the smallest angle of a triangle, which is that between its two longest edges.
double least_sine(const std::array<Vector, 3>& t) {
  double length[3];
  for (int k = 0; k < 3; ++k) length[k] = std::sqrt(squared(minus(t[(k + 1) % 3], t[k])));
  std::sort(length, length + 3);
  const double area = std::sqrt(squared(cross(minus(t[1], t[0]), minus(t[2], t[0]))));
  return length[2] > 0 ? area / (length[1] * length[2]) : 0.0;
}

// A possible collapse. It is outdated when the stamp of a vertex has changed.
struct Candidate {
  double cost;
  Row from, to;
  uint32_t from_stamp, to_stamp;

  // Least cost first in a std::priority_queue, then the lowest rows.
  bool operator<(const Candidate& other) const {
    if (cost != other.cost) return cost > other.cost;
    return std::tie(other.from, other.to) < std::tie(from, to);
  }
};

// A collapse of `from` into `to`, which moves to `place`.
struct Move {
  Row from, to;
  Vector place;
};

// Collapses edges of a mesh, as described at `simplify`.
class Simplifier {
 public:
  Simplifier(int64_t vertices, int64_t faces, const double* vertex, const int64_t* corner, const double* tolerance)
      : place_(vertices),
        given_(vertices),
        tolerance_(tolerance),
        moved_(vertices),
        border_(vertices),
        locked_(vertices),
        stamp_(vertices),
        mark_(vertices),
        quadric_(vertices),
        around_(vertices),
        corner_(faces),
        alive_(faces, 1),
        gone_(faces) {
    for (int64_t v = 0; v < vertices; ++v) place_[v] = {vertex[3 * v], vertex[3 * v + 1], vertex[3 * v + 2]};
    given_ = place_;
    for (int64_t f = 0; f < faces; ++f) {
      for (int k = 0; k < 3; ++k) corner_[f][k] = Row(corner[3 * f + k]);
      const auto [a, b, c] = corner_[f];
      if (a == b || b == c || c == a) {
        alive_[f] = 0;
        continue;
      }
      for (Row v : corner_[f]) around_[v].push_back(Row(f));
    }
    for (Row v = 0; v < Row(vertices); ++v) look_around(v);
    for (int64_t f = 0; f < faces; ++f)
      if (alive_[f]) add_face(Row(f));
  }

  Triangles run() {
    int64_t faces = std::count(alive_.begin(), alive_.end(), 1);
    while (true) {
      pass();
      const int64_t left = std::count(alive_.begin(), alive_.end(), 1);
      if (faces - left <= kWorthwhile * double(faces)) return result();
      faces = left;
    }
  }

 private:
  std::array<Vector, 3> corners(Row face) const {
    return {place_[corner_[face][0]], place_[corner_[face][1]], place_[corner_[face][2]]};
  }

  // Returns the corners of a face with the vertices `from` and `to` moved to `place`.
  std::array<Vector, 3> corners(Row face, Row from, Row to, const Vector& place) const {
    std::array<Vector, 3> t;
    for (int k = 0; k < 3; ++k) {
      const Row v = corner_[face][k];
      t[k] = v == from || v == to ? place : place_[v];
    }
    return t;
  }

  bool has(Row face, Row vertex) const {
    return corner_[face][0] == vertex || corner_[face][1] == vertex || corner_[face][2] == vertex;
  }

  // Calls body(other) for the other two vertices of each face around v: twice for a neighbour along an inner edge, once
  // along a boundary edge.
  template <class Body>
  void neighbours(Row v, const Body& body) const {
    for (Row f : around_[v])
      for (Row other : corner_[f])
        if (other != v) body(other);
  }

  // Returns the number of faces at the edge u v.
  int faces_at(Row u, Row v) const {
    return int(std::count_if(around_[u].begin(), around_[u].end(), [&](Row f) { return has(f, v); }));
  }

  // Determines whether a vertex is on a boundary, and whether it is locked: it is unless the faces around it form one
  // fan.
  void look_around(Row v) {
    int open = 0;
    bool manifold = true;
    neighbours(v, [&](Row other) {
      const int faces = faces_at(v, other);
      open += faces == 1;
      manifold &= faces <= 2;
    });
    border_[v] = open > 0;
    locked_[v] = !manifold || (open != 0 && open != 2) || !is_one_fan(v);
  }

  // Returns whether all faces around a vertex are reached from the first one through edges at the vertex.
  bool is_one_fan(Row v) const {
    std::vector<Row> reached(around_[v].begin(), around_[v].begin() + std::min<size_t>(1, around_[v].size()));
    for (size_t i = 0; i < reached.size(); ++i)
      for (Row other : corner_[reached[i]])
        if (other != v)
          for (Row f : around_[v])
            if (has(f, other) && std::find(reached.begin(), reached.end(), f) == reached.end()) reached.push_back(f);
    return reached.size() == around_[v].size();
  }

  // Adds the plane of a face to the quadrics of its corners, weighted by area / 3 over the squared tolerance.
  void add_face(Row face) {
    const auto t = corners(face);
    Vector normal = cross(minus(t[1], t[0]), minus(t[2], t[0]));
    const double area = 0.5 * normalize(normal);
    for (int k = 0; k < 3; ++k) {
      const Row v = corner_[face][k];
      const double weight = area / (3 * tolerance_[v] * tolerance_[v]);
      quadric_[v].add_corner(weight, normal, t[k]);
    }
  }

  // Fills the queue with all edges and collapses the cheapest until it is empty.
  void pass() {
    std::vector<Candidate> first;
    for (Row v = 0; v < Row(place_.size()); ++v)
      neighbours(v, [&](Row other) {
        if (v < other) add_candidate(first, v, other);
      });
    queue_ = std::priority_queue<Candidate>({}, std::move(first));
    std::vector<Candidate> changed;
    while (!queue_.empty()) {
      const Candidate best = queue_.top();
      queue_.pop();
      if (best.from_stamp != stamp_[best.from] || best.to_stamp != stamp_[best.to]) continue;
      if (!collapse(best.from, best.to)) continue;
      changed.clear();
      ++now_;
      neighbours(best.to, [&](Row other) {
        if (mark_[other] == now_) return;
        mark_[other] = now_;
        add_candidate(changed, std::min(best.to, other), std::max(best.to, other));
      });
      for (const Candidate& candidate : changed) queue_.push(candidate);
    }
  }

  // Adds the possible collapses of the edge u v.
  void add_candidate(std::vector<Candidate>& candidates, Row u, Row v) const {
    if (locked_[u] || locked_[v]) return;
    const Quadric sum = quadric_of(u, v);
    if (!(sum.weight > 0)) return;
    if (!border_[u] && !border_[v]) {
      candidates.push_back({sum.at(sum.nearest()), u, v, stamp_[u], stamp_[v]});
      return;
    }
    // At a boundary, the remaining vertex is a boundary vertex and stays in place, so that the boundary keeps its line.
    if (border_[u] && border_[v] && faces_at(u, v) != 1) return;
    for (const auto& [from, to] : {std::pair(u, v), std::pair(v, u)})
      if (border_[to]) candidates.push_back({sum.at(place_[to]), from, to, stamp_[from], stamp_[to]});
  }

  Quadric quadric_of(Row u, Row v) const {
    Quadric sum = quadric_[u];
    sum.add_quadric(quadric_[v]);
    return sum;
  }

  // Collapses `from` into `to` unless that breaks a rule; returns whether it did. Then `from` is removed and `to` has
  // its new position.
  bool collapse(Row from, Row to) {
    rest_.clear(), both_.clear();
    for (Row f : around_[from]) (has(f, to) ? both_ : rest_).push_back(f);
    for (Row f : around_[to])
      if (!has(f, from)) rest_.push_back(f);
    const bool along_border = both_.size() == 1;
    if (both_.empty() || rest_.size() < (along_border ? 1 : 3) || !keeps_topology(from, to)) return false;
    const Quadric sum = quadric_of(from, to);
    const Move how{from, to, border_[to] ? place_[to] : sum.nearest()};
    if (!keeps_shape(how) || !keeps_distance(how, along_border)) return false;

    for (Row f : both_) {
      alive_[f] = 0, gone_[f].clear(), gone_[f].shrink_to_fit();
      for (Row v : corner_[f]) std::erase(around_[v], f);
    }
    for (Row f : around_[from]) {
      std::replace(corner_[f].begin(), corner_[f].end(), from, to);
      around_[to].push_back(f);
    }
    around_[from].clear();
    for (Row f : rest_) gone_[f].clear();
    for (const auto& [vertex, face] : nearest_) gone_[face].push_back(vertex);
    if (how.place != place_[to]) moved_[to] = 1;
    moved_[from] = 1;
    place_[to] = how.place;
    quadric_[to] = sum;
    ++stamp_[from], ++stamp_[to];
    return true;
  }

  // Link condition: returns whether the two vertices have no common neighbours but those in the faces to be removed.
  bool keeps_topology(Row from, Row to) {
    ++now_;
    neighbours(from, [&](Row other) { mark_[other] = now_; });
    int common = 0;
    neighbours(to, [&](Row other) {
      if (mark_[other] != now_) return;
      mark_[other] = 0;
      ++common;
    });
    return common == int(both_.size());
  }

  // Returns whether no face folds over, loses its area, or gets an angle below 10 degrees that is smaller than all
  // before.
  bool keeps_shape(const Move& how) const {
    double before = kSliver;
    for (const auto* faces : {&both_, &rest_})
      for (Row f : *faces) before = std::min(before, least_sine(corners(f)));
    for (Row f : rest_) {
      const auto old = corners(f), now = corners(f, how.from, how.to, how.place);
      Vector a = cross(minus(old[1], old[0]), minus(old[2], old[0]));
      Vector b = cross(minus(now[1], now[0]), minus(now[2], now[0]));
      const bool had_area = normalize(a) > 0;
      if (!(normalize(b) > 0) || (had_area && dot(a, b) < kMostTurn) || least_sine(now) < before) return false;
    }
    return true;
  }

  // Returns whether the given positions of all removed and moved vertices stay within their tolerance of the faces,
  // and, in a collapse along a boundary, those of boundary vertices within it of the boundary. Then `nearest_` holds
  // the nearest face of each.
  bool keeps_distance(const Move& how, bool along_border) {
    nearest_.clear();
    ring_.clear();
    for (Row f : rest_) ring_.push_back(corners(f, how.from, how.to, how.place));
    if (along_border) find_border(how);
    const auto keep = [&](Row v) {
      double least = std::numeric_limits<double>::infinity();
      Row nearest = -1;
      for (size_t i = 0; i < ring_.size(); ++i) {
        const double distance = squared_distance_to_triangle(given_[v], ring_[i]);
        if (distance < least) least = distance, nearest = rest_[i];
      }
      nearest_.push_back({v, nearest});
      const double most = tolerance_[v] * tolerance_[v];
      return least <= most && !(along_border && border_[v] && distance_to_border(given_[v]) > most);
    };
    for (Row v : {how.from, how.to})
      if (!moved_[v] && (v == how.from || how.place != place_[v]) && !keep(v)) return false;
    for (const auto* faces : {&both_, &rest_})
      for (Row f : *faces)
        for (Row v : gone_[f])
          if (!keep(v)) return false;
    return true;
  }

  // Collects the boundary edges of the faces around, at their positions after the collapse.
  void find_border(const Move& how) {
    open_.clear();
    for (Row f : rest_)
      for (int k = 0; k < 3; ++k) {
        const Row u = corner_[f][k], v = corner_[f][(k + 1) % 3];
        if (!border_[u] || !border_[v] || faces_at(u, v) != 1) continue;
        const auto at = [&](Row w) { return w == how.from || w == how.to ? how.place : place_[w]; };
        open_.push_back({at(u), at(v)});
      }
  }

  // Returns the squared distance from these edges.
  double distance_to_border(const Vector& point) const {
    double least = std::numeric_limits<double>::infinity();
    for (const auto& [a, b] : open_) least = std::min(least, squared_distance_to_segment(point, a, b));
    return least;
  }

  // Returns the remaining vertices and faces, in the order of the given ones.
  Triangles result() const {
    std::vector<int64_t> row(place_.size(), -1);
    Triangles made;
    for (size_t f = 0; f < corner_.size(); ++f) {
      if (!alive_[f]) continue;
      for (Row v : corner_[f]) row[v] = 0;
    }
    int64_t count = 0;
    for (size_t v = 0; v < place_.size(); ++v)
      if (row[v] == 0) {
        row[v] = count++;
        made.vertex.insert(made.vertex.end(), place_[v].begin(), place_[v].end());
      }
    for (size_t f = 0; f < corner_.size(); ++f)
      if (alive_[f])
        for (Row v : corner_[f]) made.corner.push_back(row[v]);
    return made;
  }

  std::vector<Vector> place_, given_;
  const double* tolerance_;
  std::vector<uint8_t> moved_;  // whether a vertex was removed or moved, and so is kept with a face in `gone_`
  std::vector<uint8_t> border_, locked_;
  std::vector<uint32_t> stamp_, mark_;  // collapses of a vertex; last visit, in terms of `now_`
  uint32_t now_ = 0;
  std::vector<Quadric> quadric_;
  std::vector<std::vector<Row>> around_;
  std::vector<std::array<Row, 3>> corner_;
  std::vector<uint8_t> alive_;
  std::vector<std::vector<Row>> gone_;  // per face: the removed and moved vertices to which it is nearest
  std::priority_queue<Candidate> queue_;
  // Of the collapse under test: faces to be removed, faces that stay, and the corners of the latter, the boundary edges
  // and the nearest faces of removed vertices after the collapse.
  std::vector<Row> both_, rest_;
  std::vector<std::array<Vector, 3>> ring_;
  std::vector<std::array<Vector, 2>> open_;
  std::vector<std::pair<Row, Row>> nearest_;
};

}  // namespace

Triangles simplify(int64_t vertices, int64_t faces, const double* vertex, const int64_t* corner,
                   const double* tolerance) {
  return Simplifier(vertices, faces, vertex, corner, tolerance).run();
}

}  // namespace linprim
