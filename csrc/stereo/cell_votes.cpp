#include "stereo/cell_votes.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <limits>

#include "base/parallel.h"
#include "base/vector.h"

namespace linprim {
namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();
// A ray with at most this share of its length in a cell only touches the cell. Rounding in float64 moves positions by
// far less.
constexpr double kTouching = 1e-9;

// Traversal of the cells along rays from one point.
class Walk {
 public:
  Walk(const Cells& mesh, int32_t start, int64_t* votes) : mesh_(mesh), start_(start), votes_(votes) {}

  // Returns the cell around the start that a ray enters. The outward normals of its three faces at the start point away
  // from the ray; it is the cell whose largest product of these unit normals with the ray is least.
  int32_t first_cell(const Vector& ray, const int32_t* around, int64_t count) const {
    int32_t best = -1;
    double least = kInfinity;
    for (int64_t k = 0; k < count; ++k) {
      double most = -kInfinity;
      for (int face = 0; face < 4; ++face) {
        if (mesh_.corner[4 * int64_t(around[k]) + face] == start_) continue;
        const Face found = outward(around[k], face);
        most = std::max(most, dot(found.normal, ray) / std::sqrt(dot(found.normal, found.normal)));
      }
      if (most < least) least = most, best = around[k];
    }
    return best;
  }

  // Follows a ray from cell to cell and casts its votes, as described at `vote_for_cells`.
  void along(const Vector& ray, int32_t cell, double empty, double full) const {
    const Vector center = point(start_);
    const double end = std::max(empty, full);
    double at = 0;
    int32_t before = -1;
    for (int64_t step = 0; step <= mesh_.cells && at <= end; ++step) {
      if (cell < 0) {
        if (full > 0 && full >= at) vote(mesh_.cells, -1);
        return;
      }
      double leaving = kInfinity;
      int through = -1;
      for (int face = 0; face < 4; ++face) {
        if (before >= 0 && mesh_.neighbor[4 * int64_t(cell) + face] == before) continue;
        const Face found = outward(cell, face);
        const double towards = dot(found.normal, ray);
        if (!(towards > 0)) continue;
        const double reached = dot(found.normal, minus(found.place, center)) / towards;
        if (reached < leaving) leaving = reached, through = face;
      }
      leaving = std::max(leaving, at);
      if (leaving > at + kTouching && at < empty) vote(cell, 1);
      if (full >= at && full < leaving && full > 0) vote(cell, -1);
      if (through < 0) return;
      before = cell, at = leaving;
      cell = mesh_.neighbor[4 * int64_t(cell) + through];
    }
  }

 private:
  struct Face {
    Vector normal, place;
  };

  Vector point(int32_t row) const {
    const double* at = mesh_.point + 3 * int64_t(row);
    return {at[0], at[1], at[2]};
  }

  // Returns a face of a cell: its outward normal, as long as twice its area, and a point of it.
  Face outward(int32_t cell, int face) const {
    const int32_t* corner = mesh_.corner + 4 * int64_t(cell);
    const Vector a = point(corner[(face + 1) % 4]), b = point(corner[(face + 2) % 4]);
    const Vector c = point(corner[(face + 3) % 4]);
    const Vector normal = cross(minus(b, a), minus(c, a));
    const bool inward = dot(normal, minus(point(corner[face]), a)) > 0;
    return {inward ? Vector{-normal[0], -normal[1], -normal[2]} : normal, a};
  }

  // Adds votes atomically: sums of integers are the same in any order.
  void vote(int64_t cell, int64_t count) const {
    std::atomic_ref<int64_t>(votes_[cell]).fetch_add(count, std::memory_order_relaxed);
  }

  const Cells& mesh_;
  const int32_t start_;
  int64_t* votes_;
};

}  // namespace

void vote_for_cells(const Cells& mesh, int32_t start, int64_t around_count, const int32_t* around, int64_t rays,
                    const double* ray, double empty, double full, int64_t* votes) {
  if (around_count == 0) return;
  const Walk walk(mesh, start, votes);
  constexpr int64_t kRaysPerItem = 64;
  parallel_for((rays + kRaysPerItem - 1) / kRaysPerItem, [&](int64_t item, int) {
    const int64_t end = std::min((item + 1) * kRaysPerItem, rays);
    for (int64_t k = item * kRaysPerItem; k < end; ++k) {
      const Vector direction{ray[3 * k], ray[3 * k + 1], ray[3 * k + 2]};
      walk.along(direction, walk.first_cell(direction, around, around_count), empty, full);
    }
  });
}

}  // namespace linprim
