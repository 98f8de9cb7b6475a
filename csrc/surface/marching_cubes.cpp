#include "surface/marching_cubes.h"

#include <algorithm>
#include <array>
#include <unordered_map>
#include <utility>

#include "base/parallel.h"

namespace linprim {
namespace {

using Index = std::array<int64_t, 3>;

// Bits 0, 1 and 2 of a corner's number are its positions along x, y and z. An edge runs from corner `low` to corner
// `high`.
struct CubeEdge {
  int8_t low, high;
};
// Four edges along x, four along y, four along z.
constexpr CubeEdge kEdges[12] = {{0, 1}, {2, 3}, {4, 5}, {6, 7}, {0, 2}, {1, 3},
                                 {4, 6}, {5, 7}, {0, 4}, {1, 5}, {2, 6}, {3, 7}};
// Corners of the faces of a cube, counter-clockwise seen from outside.
constexpr int kFaces[6][4] = {{0, 4, 6, 2}, {1, 3, 7, 5}, {0, 1, 5, 4}, {2, 6, 7, 3}, {0, 2, 3, 1}, {4, 5, 7, 6}};

// Returns the edge between two corners, or -1.
int edge_between(int a, int b) {
  for (int e = 0; e < 12; ++e)
    if (kEdges[e].low == std::min(a, b) && kEdges[e].high == std::max(a, b)) return e;
  return -1;
}

// Returns whether two edges lie on the same face.
bool share_face(int e, int f) {
  for (const auto& face : kFaces) {
    const auto on = [&](int edge) {
      return std::count(face, face + 4, kEdges[edge].low) && std::count(face, face + 4, kEdges[edge].high);
    };
    if (on(e) && on(f)) return true;
  }
  return false;
}

// Closed polylines in which a surface cuts the faces of a cube, as sequences of the cube's edges, for one pattern of
// inner corners (bit c for corner c). If two diagonally opposite corners of a face are inside, each is cut off
// separately, which is the same for both cubes at the face. A loop starts where its triangle fan has no diagonal in a
// face of the cube: the neighbouring cube might have the same one.
using Loops = std::vector<std::vector<int8_t>>;

// Computes the loops of one pattern of inner corners.
Loops loops_of(int inside) {
  std::array<int8_t, 12> next;
  next.fill(-1);
  for (const auto& face : kFaces) {
    const auto is_inside = [&](int i) { return inside >> face[i & 3] & 1; };
    for (int i = 0; i < 4; ++i) {
      if (!is_inside(i) || is_inside(i + 3)) continue;  // a run of inner corners begins here
      int last = i;
      while (is_inside(last + 1)) ++last;
      next[edge_between(face[(i + 3) & 3], face[i])] = int8_t(edge_between(face[last & 3], face[(last + 1) & 3]));
    }
  }
  Loops loops;
  for (int8_t first = 0; first < 12; ++first) {
    std::vector<int8_t> loop;
    for (int8_t e = first; next[e] >= 0;) {
      loop.push_back(e);
      e = std::exchange(next[e], int8_t(-1));
    }
    if (loop.empty()) continue;
    const int size = int(loop.size());
    const auto crosses_a_face = [&] {
      for (int k = 2; k + 1 < size; ++k)
        if (share_face(loop[0], loop[k])) return true;
      return false;
    };
    while (crosses_a_face()) std::rotate(loop.begin(), loop.begin() + 1, loop.end());
    loops.push_back(std::move(loop));
  }
  return loops;
}

// Returns the loops of all 256 patterns.
const std::array<Loops, 256>& all_loops() {
  static const std::array<Loops, 256> table = [] {
    std::array<Loops, 256> made;
    for (int inside = 0; inside < 256; ++inside) made[inside] = loops_of(inside);
    return made;
  }();
  return table;
}

// Packs a block index into a key of 63 bits.
uint64_t packed(const Index& at) {
  constexpr int64_t kHalf = int64_t(1) << (kIndexBits - 1);
  return uint64_t(at[0] + kHalf) << (2 * kIndexBits) | uint64_t(at[1] + kHalf) << kIndexBits | uint64_t(at[2] + kHalf);
}

// Finds blocks by their level and index.
class BlockMap {
 public:
  explicit BlockMap(const VoxelBlocks& blocks) : blocks_(blocks) {
    for (int64_t row = 0; row < blocks.count; ++row) levels_ = std::max(levels_, int(blocks.level[row]) + 1);
    rows_.resize(levels_);
    for (int64_t row = 0; row < blocks.count; ++row) rows_[blocks.level[row]].emplace(packed(index(row)), row);
  }

  Index index(int64_t row) const {
    const int64_t* at = blocks_.index + 3 * row;
    return {at[0], at[1], at[2]};
  }

  // Returns the block of this level and index, or the larger block that contains it; -1 if there is none, or if only
  // smaller blocks lie there.
  int64_t find(Index at, int level) const {
    for (; level < levels_; ++level) {
      const auto found = rows_[level].find(packed(at));
      if (found != rows_[level].end()) return found->second;
      for (int64_t& x : at) x >>= 1;
    }
    return -1;
  }

 private:
  const VoxelBlocks& blocks_;
  int levels_ = 1;
  std::vector<std::unordered_map<uint64_t, int64_t>> rows_;
};

// Marches cubes. The name of a vertex holds the two voxels that it lies between, the one with the lower number in the
// upper 32 bits.
struct Marcher {
  const VoxelBlocks& blocks;
  const BlockMap& map;
  const std::array<Loops, 256>& loops;
  int n;
  int64_t size;

  explicit Marcher(const VoxelBlocks& blocks, const BlockMap& map)
      : blocks(blocks), map(map), loops(all_loops()), n(blocks.resolution), size(int64_t(n) * n * n) {}

  // Returns the voxel of a block that contains the position `place`, in finest voxels.
  uint32_t voxel(int64_t row, const Index& place) const {
    const Index at = map.index(row);
    const int level = int(blocks.level[row]);
    const int64_t x = (place[0] >> level) - at[0] * n, y = (place[1] >> level) - at[1] * n,
                  z = (place[2] >> level) - at[2] * n;
    return uint32_t(row * size + (z * n + y) * n + x);
  }

  // Appends the triangles of one cube as names of vertices. `corner` holds its voxels; where some coincide, vertices
  // and triangles that collapse are left out.
  void march(const std::array<uint32_t, 8>& corner, std::vector<uint64_t>& out) const {
    int inside = 0;
    for (int c = 0; c < 8; ++c) {
      if (!blocks.known[corner[c]]) return;
      inside |= (blocks.distance[corner[c]] < 0) << c;
    }
    for (const std::vector<int8_t>& loop : loops[inside]) {
      std::array<uint64_t, 12> name;
      int length = 0;
      for (const int8_t e : loop) {
        const uint32_t a = corner[kEdges[e].low], b = corner[kEdges[e].high];
        const uint64_t key = uint64_t(std::min(a, b)) << 32 | std::max(a, b);
        if (!length || name[length - 1] != key) name[length++] = key;
      }
      while (length > 1 && name[length - 1] == name[0]) --length;
      for (int k = 2; k < length; ++k)
        if (name[0] != name[k - 1] && name[k - 1] != name[k] && name[k] != name[0])
          out.insert(out.end(), {name[0], name[k - 1], name[k]});
    }
  }

  // Marches the cubes for which block `row` is the first of the smallest blocks of their corners.
  void march_block(int64_t row, std::vector<uint64_t>& out) const {
    const int level = int(blocks.level[row]);
    const Index at = map.index(row);
    std::array<int64_t, 27> around;
    for (int d = 0; d < 27; ++d)
      around[d] = d == 13 ? row : map.find({at[0] + d % 3 - 1, at[1] + d / 3 % 3 - 1, at[2] + d / 9 - 1}, level);
    const auto side = [&](int i) { return i < 0 ? 0 : i < n ? 1 : 2; };
    std::array<uint32_t, 8> corner;
    for (int k = 0; k <= n; ++k)
      for (int j = 0; j <= n; ++j)
        for (int i = 0; i <= n; ++i) {
          bool mine = true;
          for (int c = 0; c < 8 && mine; ++c) {
            const int x = i - 1 + (c & 1), y = j - 1 + (c >> 1 & 1), z = k - 1 + (c >> 2);
            const int64_t found = around[side(x) + 3 * side(y) + 9 * side(z)];
            if (found == row) {
              corner[c] = uint32_t(row * size + (int64_t(z) * n + y) * n + x);
              continue;
            }
            mine = found >= 0 && (blocks.level[found] > level || found > row);
            if (!mine) continue;
            // Takes the voxel of that block that touches the cube's middle: it contains the finest voxel at this corner
            // of the middle.
            Index place = {at[0] * n + i, at[1] * n + j, at[2] * n + k};
            for (int a = 0; a < 3; ++a) place[a] = (place[a] << level) - 1 + (c >> a & 1);
            corner[c] = voxel(found, place);
          }
          if (mine) march(corner, out);
        }
  }

  // Returns twice the centre of a voxel, in finest voxels, which is an integer.
  Index twice_center(uint32_t voxel) const {
    const int64_t row = voxel / size, cell = voxel % size;
    const Index at = map.index(row), in = {cell % n, cell / n % n, cell / n / n};
    const int level = int(blocks.level[row]);
    Index center;
    for (int a = 0; a < 3; ++a) center[a] = (2 * (at[a] * n + in[a]) + 1) << level;
    return center;
  }

  // Writes the position of a vertex: the zero of the distance, linear between the centres of its two voxels.
  void place(uint64_t name, double* out) const {
    const uint32_t a = uint32_t(name >> 32), b = uint32_t(name);
    const Index from = twice_center(a), to = twice_center(b);
    const double start = blocks.distance[a], share = start / (start - blocks.distance[b]);
    for (int k = 0; k < 3; ++k) out[k] = 0.5 * (double(from[k]) + share * double(to[k] - from[k]));
  }
};

}  // namespace

Triangles marching_cubes(const VoxelBlocks& blocks) {
  constexpr int64_t kBlocksPerTask = 64;
  const BlockMap map(blocks);
  const Marcher marcher(blocks, map);
  const int64_t tasks = (blocks.count + kBlocksPerTask - 1) / kBlocksPerTask;
  std::vector<std::vector<uint64_t>> parts(tasks);
  parallel_for(tasks, [&](int64_t task, int) {
    const int64_t end = std::min((task + 1) * kBlocksPerTask, blocks.count);
    for (int64_t row = task * kBlocksPerTask; row < end; ++row)
      if (blocks.owned[row]) marcher.march_block(row, parts[task]);
  });
  std::vector<uint64_t> corner;
  size_t total = 0;
  for (const auto& part : parts) total += part.size();
  corner.reserve(total);
  for (auto& part : parts) {
    corner.insert(corner.end(), part.begin(), part.end());
    part = {};
  }
  std::vector<uint64_t> names = corner;
  std::sort(names.begin(), names.end());
  names.erase(std::unique(names.begin(), names.end()), names.end());
  Triangles out{std::vector<double>(3 * names.size()), std::vector<int64_t>(corner.size())};
  for_rows(int64_t(names.size()), [&](int64_t v) { marcher.place(names[v], &out.vertex[3 * v]); });
  for_rows(int64_t(corner.size()),
           [&](int64_t c) { out.corner[c] = std::lower_bound(names.begin(), names.end(), corner[c]) - names.begin(); });
  return out;
}

}  // namespace linprim
