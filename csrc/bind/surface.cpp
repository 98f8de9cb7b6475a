// Bindings of surface functions: optical depth, sampling of photographs, visibility, depth fusion, meshes.
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <initializer_list>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "bind/arrays.h"
#include "bind/parts.h"
#include "linprim.h"
#include "surface/crease_sides.h"
#include "surface/crossings.h"
#include "surface/face_normals.h"
#include "surface/face_samples.h"
#include "surface/filter_normals.h"
#include "surface/first_hits.h"
#include "surface/fuse.h"
#include "surface/looking_views.h"
#include "surface/marching_cubes.h"
#include "surface/photo_consistency.h"
#include "surface/point_colors.h"
#include "surface/points_within.h"
#include "surface/segment_depth.h"
#include "surface/simplify.h"
#include "surface/surfels.h"
#include "surface/visible_points.h"

namespace {

// Moves the values into a numpy array that owns them.
template <class T>
nb::ndarray<nb::numpy, T, nb::ndim<1>> owned(std::vector<T>&& values) {
  auto* kept = new std::vector<T>(std::move(values));
  return {kept->data(), {kept->size()}, nb::capsule(kept, [](void* p) noexcept {
            delete static_cast<std::vector<T>*>(p);
          })};
}

// Returns the coordinates of vectors one after another, (3 N,).
std::vector<double> flat(const std::vector<linprim::Vector>& vectors) {
  std::vector<double> values(3 * vectors.size());
  for (size_t i = 0; i < vectors.size(); ++i) std::copy_n(vectors[i].data(), 3, values.data() + 3 * i);
  return values;
}

// Returns the view of a camera; `image` and `depth` may be null.
linprim::PhotoView photo_view(const Pose& pose, const std::array<double, 4>& lens, int width, int height,
                              const float* image, int channels, const float* depth) {
  linprim::PhotoView view{{}, lens[0], lens[1], lens[2], lens[3], width, height, image, channels, depth};
  std::copy_n(pose.data(), 12, view.pose);
  return view;
}

// Defines the constructor of SolidTree for one precision.
template <class Real>
void bind_tree(nb::class_<linprim::SolidTree>& tree) {
  tree.def("__init__", [](linprim::SolidTree* self, int kind, In<Real> center, In<Real> rotation, In<Real> extent,
                          In<Real> density) {
    const int64_t n = center.ndim() ? int64_t(center.shape(0)) : 0;
    if (n >= (int64_t(1) << 31)) throw std::invalid_argument("more than 2^31 primitives");
    if (kind < 0 || kind >= linprim::kKinds || !linprim::is_solid(linprim::PrimitiveKind(kind)))
      throw std::invalid_argument("segments have an optical depth in octahedra and tetrahedra only");
    const auto solid = linprim::PrimitiveKind(kind);
    const int64_t extents = linprim::traits_of(solid).extents;
    const Real *c = checked(center, {n, 3}, "center"), *r = checked(rotation, {n, 4}, "rotation");
    const Real *e = checked(extent, {n, extents}, "extent"), *d = checked(density, {n}, "density");
    nb::gil_scoped_release release;
    new (self) linprim::SolidTree(solid, n, c, r, e, d);
  });
}

}  // namespace

void bind_surface(nb::module_& m) {
  auto tree = nb::class_<linprim::SolidTree>(m, "SolidTree");
  bind_tree<float>(tree), bind_tree<double>(tree);
  tree.def("__len__", &linprim::SolidTree::size);
  tree.def("optical_depth", [](const linprim::SolidTree& self, In<double> origin, In<double> ends,
                               std::optional<In<double>> begin, double most, Out<double> depth) {
    const int64_t count = int64_t(depth.size());
    const double *from = checked(origin, {3}, "origin"), *to = checked(ends, {count, 3}, "ends");
    const double* start = begin ? checked(*begin, {count}, "begin") : nullptr;
    double* sums = checked(depth, {count}, "depth");
    if (!(most > 0)) throw std::invalid_argument("most has to be positive");
    nb::gil_scoped_release release;
    self.optical_depth(from, to, start, count, most, sums);
  });
  m.def("add_photo", [](Pose pose, std::array<double, 4> lens, In<float> image, In<float> depth, In<float> jump,
                        std::array<double, 2> rules, In<double> offset, In<double> point, In<double> normal,
                        In<double> footprint, Out<int32_t> views, Out<float> weight, Out<float> value,
                        Out<float> square) {
    if (image.ndim() != 2 || image.size() == 0) throw std::invalid_argument("image has to have shape (H, W)");
    const int64_t height = int64_t(image.shape(0)), width = int64_t(image.shape(1));
    const int64_t count = int64_t(views.size()), offsets = int64_t(offset.size());
    const linprim::PhotoView view =
        photo_view(pose, lens, int(width), int(height), image.data(), 1, checked(depth, {height, width}, "depth"));
    const float* jumps = checked(jump, {height, width}, "jump");
    const linprim::PhotoSums sums{count,
                                  checked(point, {count, 3}, "point"),
                                  checked(normal, {count, 3}, "normal"),
                                  checked(footprint, {count}, "footprint"),
                                  checked(views, {count}, "views"),
                                  checked(weight, {count}, "weight"),
                                  checked(value, {count, offsets}, "value"),
                                  checked(square, {count, offsets}, "square")};
    const double* along = checked(offset, {offsets}, "offset");
    nb::gil_scoped_release release;
    linprim::add_photo(view, jumps, {rules[0], rules[1]}, along, int(offsets), sums);
  });
  m.def("add_colors", [](Pose pose, std::array<double, 4> lens, In<float> image, In<float> depth, In<float> near,
                         In<float> far, std::array<double, 4> rules, In<double> point, In<double> normal,
                         Out<float> best, Out<float> shade, Out<uint8_t> good) {
    if (image.ndim() != 3 || image.size() == 0 || (image.shape(2) != 3 && image.shape(2) != 4))
      throw std::invalid_argument("image has to have shape (H, W, 3) or (H, W, 4)");
    const int64_t height = int64_t(image.shape(0)), width = int64_t(image.shape(1)), count = int64_t(good.size());
    const linprim::PhotoView view = photo_view(pose, lens, int(width), int(height), image.data(), int(image.shape(2)),
                                               checked(depth, {height, width}, "depth"));
    const float *nearest = checked(near, {height, width}, "near"), *farthest = checked(far, {height, width}, "far");
    const int64_t kept = linprim::kKeptSamples;
    const linprim::ColorSamples samples{count,
                                        checked(point, {count, 3}, "point"),
                                        checked(normal, {count, 3}, "normal"),
                                        checked(best, {count, kept}, "best"),
                                        checked(shade, {count, kept, 3}, "shade"),
                                        checked(good, {count}, "good")};
    nb::gil_scoped_release release;
    linprim::add_colors(view, nearest, farthest, {rules[0], rules[1], rules[2], rules[3]}, samples);
  });
  m.def("least_footprints", [](Pose pose, std::array<double, 4> lens, int width, int height, double least_cosine,
                               In<double> point, In<double> normal, Out<double> least) {
    const int64_t count = int64_t(least.size());
    const linprim::PhotoView view = photo_view(pose, lens, width, height, nullptr, 0, nullptr);
    const double *at = checked(point, {count, 3}, "point"), *along = checked(normal, {count, 3}, "normal");
    double* out = checked(least, {count}, "least");
    nb::gil_scoped_release release;
    linprim::least_footprints(view, least_cosine, at, along, count, out);
  });
  // Returns (2 Q,) pixel coordinates, (Q,) depths.
  m.def("visible_points",
        [](Pose pose, std::array<double, 4> lens, int width, int height, In<double> point, Out<uint8_t> inside) {
          const int64_t count = int64_t(inside.size());
          const linprim::PhotoView view = photo_view(pose, lens, width, height, nullptr, 0, nullptr);
          const double* at = checked(point, {count, 3}, "point");
          uint8_t* shown = checked(inside, {count}, "inside");
          linprim::VisiblePoints found;
          {
            nb::gil_scoped_release release;
            found = linprim::visible_points(view, at, count, shown);
          }
          return std::tuple(owned(std::move(found.place)), owned(std::move(found.depth)));
        });
  m.def("count_looking_views", [](const std::vector<std::tuple<Pose, std::array<double, 4>, In<float>>>& views,
                                  In<double> point, double margin, Out<int32_t> looking, Out<int32_t> knowing) {
    const int64_t count = int64_t(looking.size());
    std::vector<linprim::PhotoView> seen;
    for (const auto& [pose, lens, depth] : views) {
      if (depth.ndim() != 2) throw std::invalid_argument("depth has to have shape (H, W)");
      seen.push_back(photo_view(pose, lens, int(depth.shape(1)), int(depth.shape(0)), nullptr, 0, depth.data()));
    }
    const double* at = checked(point, {count, 3}, "point");
    int32_t *looks = checked(looking, {count}, "looking"), *knows = checked(knowing, {count}, "knowing");
    nb::gil_scoped_release release;
    linprim::count_looking_views(seen, at, count, margin, looks, knows);
  });
  m.def("face_samples", [](Pose pose, std::array<double, 4> lens, In<float> depth, In<double> vertex,
                           In<int64_t> corner, In<double> bary, double behind, double slack, In<uint8_t> skip,
                           Out<uint8_t> found) {
    if (depth.ndim() != 2) throw std::invalid_argument("depth has to have shape (H, W)");
    const int64_t samples = int64_t(bary.shape(0)), count = int64_t(found.size()), vertices = int64_t(vertex.shape(0));
    if (samples > linprim::kMostFaceSamples) throw std::invalid_argument("too many samples");
    const linprim::PhotoView view =
        photo_view(pose, lens, int(depth.shape(1)), int(depth.shape(0)), nullptr, 0, depth.data());
    const linprim::Faces faces{count, checked(vertex, {vertices, 3}, "vertex"),
                               rows_of(corner, {count, 3}, vertices, "corner"), checked(skip, {count}, "skip")};
    const double* weights = checked(bary, {samples, 3}, "bary");
    uint8_t* out = checked(found, {count}, "found");
    nb::gil_scoped_release release;
    linprim::face_samples(view, faces, weights, int(samples), behind, slack, out);
  });
  // Returns (N,) the number of points in each body, and the rows of these points, body by body.
  m.def("points_within", [](In<double> center, In<double> normal, In<double> offset, In<double> point, double enlarged,
                            int64_t least) {
    if (normal.ndim() != 3) throw std::invalid_argument("normal has to have shape (N, F, 3)");
    const int64_t count = int64_t(normal.shape(0)), faces = int64_t(normal.shape(1)), points = int64_t(point.shape(0));
    const linprim::ConvexBodies bodies{count, int(faces), checked(center, {count, 3}, "center"),
                                       checked(normal, {count, faces, 3}, "normal"),
                                       checked(offset, {count, faces}, "offset")};
    const double* at = checked(point, {points, 3}, "point");
    std::vector<std::vector<int64_t>> found;
    {
      nb::gil_scoped_release release;
      found = linprim::points_within(bodies, at, points, enlarged, least);
    }
    size_t total = 0;
    for (const auto& rows : found) total += rows.size();
    std::vector<int64_t> sizes, all;
    sizes.reserve(found.size()), all.reserve(total);
    for (const auto& rows : found)
      sizes.push_back(int64_t(rows.size())), all.insert(all.end(), rows.begin(), rows.end());
    return std::tuple(owned(std::move(sizes)), owned(std::move(all)));
  });
  m.def("first_hits", [](Pose pose, std::array<double, 4> lens, In<double> vertex, In<int64_t> corner, Out<float> depth,
                         Out<int32_t> face) {
    if (depth.ndim() != 2) throw std::invalid_argument("depth has to have shape (H, W)");
    const int64_t height = int64_t(depth.shape(0)), width = int64_t(depth.shape(1));
    const int64_t vertices = int64_t(vertex.shape(0)), faces = int64_t(corner.shape(0));
    const double* at = checked(vertex, {vertices, 3}, "vertex");
    const int64_t* corners = rows_of(corner, {faces, 3}, vertices, "corner");
    int32_t* hit = checked(face, {height, width}, "face");
    if (std::max({faces, height, width}) > INT32_MAX) throw std::invalid_argument("more than 2^31 faces or pixels");
    const linprim::PhotoView view = photo_view(pose, lens, int(width), int(height), nullptr, 0, nullptr);
    nb::gil_scoped_release release;
    linprim::first_hits(view, vertices, at, faces, corners, depth.data(), hit);
  });
  m.def("make_surfels",
        [](Pose pose, std::array<double, 4> lens, In<double> depth, In<uint8_t> background, In<uint8_t> clamped,
           In<double> confidence, std::array<double, 4> rules, Out<float> surfels) {
          if (depth.ndim() != 2) throw std::invalid_argument("depth has to have shape (H, W)");
          const int64_t height = int64_t(depth.shape(0)), width = int64_t(depth.shape(1));
          if (std::max(height, width) > INT32_MAX) throw std::invalid_argument("too many pixels");
          linprim::DepthMap map{{},
                                lens[0],
                                lens[1],
                                lens[2],
                                lens[3],
                                int(width),
                                int(height),
                                depth.data(),
                                checked(background, {height, width}, "background"),
                                checked(clamped, {height, width}, "clamped"),
                                checked(confidence, {height, width}, "confidence")};
          std::copy_n(pose.data(), 12, map.pose);
          float* table = checked(surfels, {height * width, linprim::kSurfelColumns}, "surfels");
          const auto [voxel, truncation, slope_ratio, least_cosine] = rules;
          nb::gil_scoped_release release;
          linprim::make_surfels(map, {voxel, truncation, slope_ratio, least_cosine},
                                reinterpret_cast<linprim::Surfel*>(table));
        });
  m.def("add_votes", [](Pose project, int width, int height, In<float> surfels, std::array<float, 8> rules,
                        In<int64_t> rows, In<double> corner, double voxel, int resolution, Out<float> total,
                        Out<float> weight, Out<float> free) {
    const int64_t blocks = int64_t(corner.shape(0)), count = int64_t(rows.size()),
                  voxels = int64_t(resolution) * resolution * resolution;
    const float* table = checked(surfels, {int64_t(height) * width, linprim::kSurfelColumns}, "surfels");
    linprim::SurfelView view{{}, width, height, reinterpret_cast<const linprim::Surfel*>(table)};
    std::copy_n(project.data(), 12, view.project);
    const auto [near, far_front, behind, behind_weight, grazed, grazed_reach, grazed_weight, occluded] = rules;
    const linprim::VoteRules how{near, far_front, behind, behind_weight, grazed, grazed_reach, grazed_weight, occluded};
    const linprim::VoxelSums sums{checked(corner, {blocks, 3}, "corner"),
                                  voxel,
                                  resolution,
                                  checked(total, {blocks, voxels}, "total"),
                                  checked(weight, {blocks, voxels}, "weight"),
                                  checked(free, {blocks, voxels}, "free")};
    const int64_t* chosen = checked(rows, {count}, "rows");
    if (std::any_of(chosen, chosen + count, [&](int64_t row) { return row < 0 || row >= blocks; }))
      throw std::invalid_argument("rows are outside of the blocks");
    nb::gil_scoped_release release;
    linprim::add_votes(view, how, chosen, count, sums);
  });
  // Returns (3 V,) vertices and (3 F,) corners.
  m.def("marching_cubes", [](In<int64_t> index, In<int64_t> level, int resolution, In<float> distance,
                             In<uint8_t> known, In<uint8_t> mine) {
    const int64_t count = int64_t(level.size()), voxels = int64_t(resolution) * resolution * resolution;
    const linprim::VoxelBlocks blocks{count,
                                      resolution,
                                      checked(index, {count, 3}, "index"),
                                      checked(level, {count}, "level"),
                                      checked(distance, {count, voxels}, "distance"),
                                      checked(known, {count, voxels}, "known"),
                                      checked(mine, {count}, "owned")};
    constexpr int64_t kFarthest = (int64_t(1) << (linprim::kIndexBits - 1)) - 2;
    const auto outside = [](int64_t low, int64_t high) {
      return [=](int64_t value) { return value < low || value > high; };
    };
    if (resolution < 1 || count * voxels > int64_t(UINT32_MAX)) throw std::invalid_argument("too many voxels");
    if (std::any_of(blocks.index, blocks.index + 3 * count, outside(-kFarthest, kFarthest)))
      throw std::invalid_argument("index is too large");
    if (std::any_of(blocks.level, blocks.level + count, outside(0, linprim::kMostLevels - 1)))
      throw std::invalid_argument("level is out of range");
    linprim::Triangles found;
    {
      nb::gil_scoped_release release;
      found = linprim::marching_cubes(blocks);
    }
    return std::tuple(owned(std::move(found.vertex)), owned(std::move(found.corner)));
  });
  m.def("filter_normals", [](In<int64_t> corner, In<double> bound, double contrast, int normal_rounds,
                             int vertex_rounds, Out<double> vertex) {
    const int64_t vertices = int64_t(bound.size()), faces = int64_t(corner.shape(0));
    const double* most = checked(bound, {vertices}, "bound");
    double* moved = checked(vertex, {vertices, 3}, "vertex");
    const int64_t* corners = rows_of(corner, {faces, 3}, vertices, "corner");
    if (!(contrast > 0)) throw std::invalid_argument("contrast has to be positive");
    nb::gil_scoped_release release;
    linprim::filter_normals({contrast, normal_rounds, vertex_rounds}, vertices, faces, corners, most, moved);
  });
  // Returns (2 N,) ends, (8 N,) planes, (N,) whether the edge crosses a crease, (N,) median length of the edges around.
  m.def("crease_edges", [](In<int64_t> corner, In<double> vertex, std::array<double, 9> rules) {
    const int64_t vertices = int64_t(vertex.shape(0)), faces = int64_t(corner.shape(0));
    const double* at = checked(vertex, {vertices, 3}, "vertex");
    const int64_t* corners = rows_of(corner, {faces, 3}, vertices, "corner");
    const auto [contrast, normal_rounds, flat, side, crease, even, rings, falloff, wide] = rules;
    if (!(contrast > 0 && falloff > 0)) throw std::invalid_argument("contrast and falloff have to be positive");
    if (std::max(vertices, faces) > INT32_MAX) throw std::invalid_argument("more than 2^31 faces");
    const linprim::CreaseRules how{contrast, int(normal_rounds), flat, side, crease, even, int(rings), falloff, wide};
    linprim::CreaseEdges found;
    {
      nb::gil_scoped_release release;
      found = linprim::crease_edges(how, vertices, faces, corners, at);
    }
    return std::tuple(owned(std::move(found.end)), owned(std::move(found.plane)), owned(std::move(found.crosses)),
                      owned(std::move(found.length)));
  });
  // Returns (3 V,) normals of vertices, (3 F,) normals of faces.
  m.def("normals", [](In<int64_t> corner, In<double> vertex) {
    const int64_t vertices = int64_t(vertex.shape(0)), faces = int64_t(corner.shape(0));
    const double* at = checked(vertex, {vertices, 3}, "vertex");
    const int64_t* corners = rows_of(corner, {faces, 3}, vertices, "corner");
    std::vector<double> of_vertices, of_faces;
    {
      nb::gil_scoped_release release;
      const linprim::FaceFans fans(vertices, faces, corners);
      const linprim::FaceNormals found = linprim::face_normals(fans, at);
      of_faces = flat(found.normal), of_vertices = flat(linprim::vertex_normals(fans, found, at));
    }
    return std::tuple(owned(std::move(of_vertices)), owned(std::move(of_faces)));
  });
  // Returns (N,) pierced faces and (N,) rows of the edges that pierce them.
  m.def("crossings", [](In<int64_t> corner, In<double> vertex, In<int64_t> end) {
    const int64_t vertices = int64_t(vertex.shape(0)), faces = int64_t(corner.shape(0)), edges = int64_t(end.shape(0));
    const double* at = checked(vertex, {vertices, 3}, "vertex");
    if (!std::all_of(at, at + 3 * vertices, [](double x) { return std::isfinite(x); }))
      throw std::invalid_argument("vertices are not finite");
    const int64_t *corners = rows_of(corner, {faces, 3}, vertices, "corner"),
                  *ends = rows_of(end, {edges, 2}, vertices, "end");
    linprim::Crossings found;
    {
      nb::gil_scoped_release release;
      found = linprim::crossings(vertices, at, faces, corners, edges, ends);
    }
    return std::tuple(owned(std::move(found.face)), owned(std::move(found.edge)));
  });
  // Returns (3 V,) vertices, (3 F,) corners.
  m.def("simplify", [](In<int64_t> corner, In<double> vertex, In<double> tolerance) {
    const int64_t vertices = int64_t(vertex.shape(0)), faces = int64_t(corner.shape(0));
    const double* at = checked(vertex, {vertices, 3}, "vertex");
    const double* most = checked(tolerance, {vertices}, "tolerance");
    const int64_t* corners = rows_of(corner, {faces, 3}, vertices, "corner");
    if (std::max(vertices, faces) > INT32_MAX) throw std::invalid_argument("more than 2^31 faces");
    if (!std::all_of(most, most + vertices, [](double value) { return value > 0; }))
      throw std::invalid_argument("tolerance has to be positive");
    linprim::Triangles found;
    {
      nb::gil_scoped_release release;
      found = linprim::simplify(vertices, faces, at, corners, most);
    }
    return std::tuple(owned(std::move(found.vertex)), owned(std::move(found.corner)));
  });
}
