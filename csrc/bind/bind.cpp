// The compiled module linprim_geo._core: checks shapes, releases the interpreter lock, calls the core. No arithmetic
// here.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "raster/environment.h"
#include "surface/face_samples.h"
#include "surface/fuse.h"
#include "linprim.h"
#include "base/parallel.h"
#include "surface/photo_sweep.h"
#include "surface/point_colors.h"
#include "surface/points_within.h"
#include "stereo/patch_match.h"
#include "surface/segment_depth.h"

namespace nb = nanobind;

namespace {

template <class T>
using In = nb::ndarray<const T, nb::c_contig, nb::device::cpu>;
template <class T>
using Out = nb::ndarray<T, nb::c_contig, nb::device::cpu>;
using Pose = nb::ndarray<const double, nb::shape<3, 4>, nb::c_contig, nb::device::cpu>;

// Ray model, order, screen filter.
using Rung = std::tuple<int, int, double>;

template <class Array>
auto checked(const Array& array, std::initializer_list<int64_t> shape, const char* name) {
  bool same = array.ndim() == shape.size();
  size_t axis = 0;
  for (int64_t size : shape) {
    if (same && int64_t(array.shape(axis)) != size) same = false;
    ++axis;
  }
  if (!same) {
    std::string wanted, found;
    for (int64_t size : shape) wanted += (wanted.empty() ? "" : ", ") + std::to_string(size);
    for (size_t a = 0; a < array.ndim(); ++a) found += (a ? ", " : "") + std::to_string(array.shape(a));
    throw std::invalid_argument(std::string(name) + " has shape (" + found + "), wanted (" + wanted + ")");
  }
  return array.data();
}

// A numpy array that has the values.
nb::ndarray<nb::numpy, int64_t, nb::ndim<1>> owned(std::vector<int64_t>&& values) {
  auto* kept = new std::vector<int64_t>(std::move(values));
  return {kept->data(), {kept->size()}, nb::capsule(kept, [](void* p) noexcept {
            delete static_cast<std::vector<int64_t>*>(p);
          })};
}

linprim::PhotoView photo_view(const Pose& pose, const std::array<double, 4>& lens, int width, int height,
                              const float* image, int channels, const float* depth) {
  linprim::PhotoView view{{}, lens[0], lens[1], lens[2], lens[3], width, height, image, channels, depth};
  std::copy_n(pose.data(), 12, view.pose);
  return view;
}

linprim::View make_view(const Pose& pose, const std::tuple<double, double, double, double>& intrinsics, int width,
                        int height, double near, double stop, double level, const Rung& rung) {
  linprim::View view{};
  const auto [rays, order, screen_filter] = rung;
  if (rays < 0 || rays >= linprim::kRayModels || order < 0 || order >= linprim::kOrders)
    throw std::invalid_argument("unknown ray model or order");
  if (!(screen_filter >= 0) || !std::isfinite(screen_filter))
    throw std::invalid_argument("screen_filter has to be 0 or positive");
  view.rays = linprim::RayModel(rays), view.order = linprim::Order(order), view.screen_filter = screen_filter;
  for (int i = 0; i < 12; ++i) view.world_to_camera[i] = pose.data()[i];
  std::tie(view.fx, view.fy, view.cx, view.cy) = intrinsics;
  view.width = width, view.height = height, view.near = near, view.stop = stop, view.level = level;
  if (width < 1 || height < 1 || int64_t(width) * height > (int64_t(1) << 31))
    throw std::invalid_argument("the image size is not positive, or above 2^31 pixels");
  bool finite = std::isfinite(view.fx) && std::isfinite(view.fy) && std::isfinite(view.cx) && std::isfinite(view.cy);
  for (double x : view.world_to_camera) finite = finite && std::isfinite(x);
  if (!finite) throw std::invalid_argument("the camera's pose or intrinsics are not finite");
  if (!(stop >= 0 && stop < 1)) throw std::invalid_argument("stop has to be in [0, 1)");
  if (!(near > 0) || !(view.fx > 0) || !(view.fy > 0))
    throw std::invalid_argument("near and the focal lengths have to be positive");
  return view;
}

template <class Real>
linprim::Primitives<Real> make_primitives(int kind, const In<Real>& center, const In<Real>& rotation,
                                          const In<Real>& extent, const In<Real>& density, const In<Real>& sh) {
  const int64_t n = center.ndim() ? int64_t(center.shape(0)) : 0;
  const int64_t count = sh.ndim() == 3 ? int64_t(sh.shape(1)) : 0;
  if (count != 1 && count != 4 && count != 9 && count != 16)
    throw std::invalid_argument("sh has to have shape (N, 1 | 4 | 9 | 16, 3)");
  if (n >= (int64_t(1) << 31)) throw std::invalid_argument("more than 2^31 primitives");
  if (kind < 0 || kind >= linprim::kKinds) throw std::invalid_argument("unknown kind of primitive");
  const int64_t extents = linprim::PrimitiveKind(kind) == linprim::PrimitiveKind::kTetrahedron ? 4 : 3;
  return {linprim::PrimitiveKind(kind),
          n,
          checked(center, {n, 3}, "center"),
          checked(rotation, {n, 4}, "rotation"),
          checked(extent, {n, extents}, "extent"),
          checked(density, {n}, "density"),
          checked(sh, {n, count, 3}, "sh"),
          int(count)};
}

// A view's directions, whose size is that of `opacity` (H, W), and the cube map that it looks at.
template <class Real, class Map>
std::pair<linprim::DirectionView, linprim::CubeMap<Real>> seen_directions(const std::array<double, 9>& rotation,
                                                                          const std::array<double, 4>& lens,
                                                                          const Map& map, const In<Real>& opacity) {
  if (opacity.ndim() != 2 || opacity.size() == 0) throw std::invalid_argument("opacity has to have shape (H, W)");
  if (map.ndim() != 4 || map.size() == 0) throw std::invalid_argument("the map has to have shape (6, S, S, 3)");
  linprim::DirectionView view{{}, lens[0], lens[1], lens[2], lens[3], int(opacity.shape(1)), int(opacity.shape(0))};
  std::copy_n(rotation.data(), 9, view.rotation);
  bool finite = view.fx > 0 && view.fy > 0;
  for (double x : rotation) finite = finite && std::isfinite(x);
  for (double x : lens) finite = finite && std::isfinite(x);
  if (!finite) throw std::invalid_argument("the camera's rotation or intrinsics are not finite");
  const int64_t size = int64_t(map.shape(1));
  if (size > 8192) throw std::invalid_argument("a side of the map has more than 8192 texels");
  return {view, {checked(map, {6, size, size, 3}, "the map"), int(size)}};
}

// Planes in the order rgb, opacity, depth_expected, depth_median, depth_first, distortion, normal, normal_median,
// state.
template <class Real, class Array>
linprim::Planes<Real> make_planes(const std::vector<std::optional<Array>>& arrays, int64_t height, int64_t width) {
  constexpr const char* kNames[] = {"rgb",        "opacity", "depth_expected", "depth_median", "depth_first",
                                    "distortion", "normal",  "normal_median",  "state"};
  constexpr int kChannels[] = {3, 0, 0, 0, 0, 0, 3, 3, 4};
  Real* planes[9] = {};
  for (size_t i = 0; i < arrays.size() && i < 9; ++i)
    if (arrays[i]) {
      auto data = kChannels[i] ? checked(*arrays[i], {kChannels[i], height, width}, kNames[i])
                               : checked(*arrays[i], {height, width}, kNames[i]);
      planes[i] = const_cast<Real*>(data);
    }
  return {planes[0], planes[1], planes[2], planes[3], planes[4], planes[5], planes[6], planes[7], planes[8]};
}

template <class Real>
void require_planes(const linprim::Planes<Real>& p, bool geometry) {
  bool all = p.rgb && p.opacity;
  if (geometry)
    all = all && p.depth_expected && p.depth_median && p.depth_first && p.distortion && p.normal && p.normal_median &&
          p.state;
  if (!all) throw std::invalid_argument("an output plane is missing");
}

template <class Real>
void require_kernels(const linprim::View& view, const linprim::Primitives<Real>& primitives) {
  if (!linprim::has_kernels<Real>(primitives.kind, view.rays, view.order))
    throw std::invalid_argument(
        "these primitives cannot be blended in this order: a Gaussian has no entry and no exit");
}

template <class Real>
void bind_real(nb::module_& m, const char* suffix) {
  using namespace nb::literals;
  using Array = In<Real>;
  m.def((std::string("rasterize_") + suffix).c_str(),
        [](int kind, Array center, Array rotation, Array extent, Array density, Array sh, Array background, Pose pose,
           std::tuple<double, double, double, double> intrinsics, int width, int height, double near, double stop,
           double level, Rung rung, bool geometry, std::vector<std::optional<Out<Real>>> planes, Out<Real> color,
           Out<Real> max_weight, Out<int32_t> pixels) {
          const linprim::View view = make_view(pose, intrinsics, width, height, near, stop, level, rung);
          const auto primitives = make_primitives<Real>(kind, center, rotation, extent, density, sh);
          require_kernels<Real>(view, primitives);
          const auto out = make_planes<Real, Out<Real>>(planes, height, width);
          require_planes(out, geometry);
          const int64_t stats = geometry ? primitives.n : 0;
          const Real* bg = checked(background, {3}, "background");
          Real* colors = checked(color, {primitives.n, 3}, "color");
          Real* weights = checked(max_weight, {stats}, "max_weight");
          int32_t* counts = checked(pixels, {stats}, "pixels");
          nb::gil_scoped_release release;
          linprim::rasterize<Real>(view, primitives, bg, geometry, out, colors, weights, counts);
        });
  m.def(
      (std::string("rasterize_grad_") + suffix).c_str(),
      [](int kind, Array center, Array rotation, Array extent, Array density, Array sh, Array background, Pose pose,
         std::tuple<double, double, double, double> intrinsics, int width, int height, double near, double stop,
         double level, Rung rung, bool geometry, std::vector<std::optional<Array>> planes, Array color,
         std::vector<std::optional<Array>> grads, Out<Real> center_grad, Out<Real> rotation_grad, Out<Real> extent_grad,
         Out<Real> density_grad, Out<Real> sh_grad, Out<Real> background_grad, Out<Real> screen_grad) {
        const linprim::View view = make_view(pose, intrinsics, width, height, near, stop, level, rung);
        const auto primitives = make_primitives<Real>(kind, center, rotation, extent, density, sh);
        require_kernels<Real>(view, primitives);
        const auto out = make_planes<Real, Array>(planes, height, width);
        require_planes(out, geometry);
        const auto grad = make_planes<Real, Array>(grads, height, width);
        const Real* bg = checked(background, {3}, "background");
        const Real* colors = checked(color, {primitives.n, 3}, "color");
        const linprim::PrimitiveGradients<Real> gradients{
            checked(center_grad, {primitives.n, 3}, "center_grad"),
            checked(rotation_grad, {primitives.n, 4}, "rotation_grad"),
            checked(extent_grad, {primitives.n, primitives.extents()}, "extent_grad"),
            checked(density_grad, {primitives.n}, "density_grad"),
            checked(sh_grad, {primitives.n, primitives.sh_count, 3}, "sh_grad"),
            checked(screen_grad, {primitives.n, 3}, "screen_grad")};
        Real* bg_grad = checked(background_grad, {3}, "background_grad");
        nb::gil_scoped_release release;
        linprim::rasterize_grad<Real>(view, primitives, bg, geometry, out, colors, grad, gradients, bg_grad);
      });
  m.def((std::string("level_depth_") + suffix).c_str(),
        [](int kind, Array center, Array rotation, Array extent, Array density, Array sh, Pose pose,
           std::tuple<double, double, double, double> intrinsics, int width, int height, double near, double level,
           Rung rung, Out<Real> depth, Out<Real> opacity) {
          const linprim::View view = make_view(pose, intrinsics, width, height, near, 0, level, rung);
          const auto primitives = make_primitives<Real>(kind, center, rotation, extent, density, sh);
          if (primitives.kind == linprim::PrimitiveKind::kGaussian)
            throw std::invalid_argument("a Gaussian has no entry and no exit");
          Real *depths = checked(depth, {height, width}, "depth"),
               *opacities = checked(opacity, {height, width}, "opacity");
          nb::gil_scoped_release release;
          linprim::level_depth<Real>(view, primitives, depths, opacities);
        });
  auto bind_average = [&](const char* name, auto function) {
    m.def((std::string(name) + suffix).c_str(),
          [function](Array from, int height, int width, int factor, Out<Real> to) {
            const int64_t coarse = int64_t(height) * width, fine = coarse * factor * factor;
            if (factor < 1 || coarse < 1) throw std::invalid_argument("sizes have to be positive");
            const int64_t planes = int64_t(std::min(from.size(), to.size())) / coarse;
            if (std::min<int64_t>(from.size(), to.size()) != planes * coarse ||
                std::max<int64_t>(from.size(), to.size()) != planes * fine)
              throw std::invalid_argument("the two images do not fit the sizes");
            const Real* in = from.data();
            Real* out = to.data();
            nb::gil_scoped_release release;
            function(in, int(planes), width, height, factor, out);
          });
  };
  m.def((std::string("environment_light_") + suffix).c_str(),
        [](std::array<double, 9> rotation, std::array<double, 4> lens, Array map, double least, Array opacity,
           Out<Real> light) {
          const auto [view, cube] = seen_directions<Real>(rotation, lens, map, opacity);
          Real* image = checked(light, {3, view.height, view.width}, "light");
          nb::gil_scoped_release release;
          linprim::environment_light<Real>(view, cube, least, opacity.data(), image);
        });
  m.def((std::string("environment_light_grad_") + suffix).c_str(),
        [](std::array<double, 9> rotation, std::array<double, 4> lens, double least, Array opacity, Array light_grad,
           Out<Real> map_grad) {
          const auto [view, cube] = seen_directions<Real>(rotation, lens, map_grad, opacity);
          const Real* grad = checked(light_grad, {3, view.height, view.width}, "light_grad");
          nb::gil_scoped_release release;
          linprim::environment_light_grad<Real>(view, cube.size, least, opacity.data(), grad, map_grad.data());
        });
  bind_average("average_pixels_", &linprim::average_pixels<Real>);
  bind_average("average_pixels_grad_", &linprim::average_pixels_grad<Real>);
  m.def((std::string("has_kernels_") + suffix).c_str(), [](int kind, int rays, int order) {
    if (kind < 0 || kind >= linprim::kKinds || rays < 0 || rays >= linprim::kRayModels || order < 0 ||
        order >= linprim::kOrders)
      return false;
    return linprim::has_kernels<Real>(linprim::PrimitiveKind(kind), linprim::RayModel(rays), linprim::Order(order));
  });
  m.def((std::string("first_non_finite_") + suffix).c_str(), [](Array values) {
    const Real* data = values.data();
    const int64_t n = int64_t(values.size());
    nb::gil_scoped_release release;
    return linprim::first_non_finite<Real>(data, n);
  });
}

template <class Real>
void bind_tree(nb::class_<linprim::SolidTree>& tree) {
  tree.def("__init__", [](linprim::SolidTree* self, int kind, In<Real> center, In<Real> rotation, In<Real> extent,
                          In<Real> density) {
    const int64_t n = center.ndim() ? int64_t(center.shape(0)) : 0;
    if (n >= (int64_t(1) << 31)) throw std::invalid_argument("more than 2^31 primitives");
    if (kind != int(linprim::PrimitiveKind::kOctahedron) && kind != int(linprim::PrimitiveKind::kTetrahedron))
      throw std::invalid_argument("segments have an optical depth in octahedra and tetrahedra only");
    const auto solid = linprim::PrimitiveKind(kind);
    const int64_t extents = solid == linprim::PrimitiveKind::kTetrahedron ? 4 : 3;
    const Real *c = checked(center, {n, 3}, "center"), *r = checked(rotation, {n, 4}, "rotation");
    const Real *e = checked(extent, {n, extents}, "extent"), *d = checked(density, {n}, "density");
    nb::gil_scoped_release release;
    new (self) linprim::SolidTree(solid, n, c, r, e, d);
  });
}

}  // namespace

NB_MODULE(_core, m) {
  bind_real<float>(m, "f32");
  bind_real<double>(m, "f64");
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
  m.def("face_samples", [](Pose pose, std::array<double, 4> lens, In<float> depth, In<double> vertex,
                           In<int64_t> corner, In<double> bary, double behind, double slack, In<uint8_t> skip,
                           Out<uint8_t> found) {
    if (depth.ndim() != 2) throw std::invalid_argument("depth has to have shape (H, W)");
    const int64_t samples = int64_t(bary.shape(0)), count = int64_t(found.size()), vertices = int64_t(vertex.shape(0));
    if (samples > linprim::kMostFaceSamples) throw std::invalid_argument("too many samples");
    const linprim::PhotoView view =
        photo_view(pose, lens, int(depth.shape(1)), int(depth.shape(0)), nullptr, 0, depth.data());
    const linprim::Faces faces{count, checked(vertex, {vertices, 3}, "vertex"), checked(corner, {count, 3}, "corner"),
                               checked(skip, {count}, "skip")};
    if (std::any_of(faces.corner, faces.corner + 3 * count, [&](int64_t row) { return row < 0 || row >= vertices; }))
      throw std::invalid_argument("corners are outside of the vertices");
    const double* weights = checked(bary, {samples, 3}, "bary");
    uint8_t* out = checked(found, {count}, "found");
    nb::gil_scoped_release release;
    linprim::face_samples(view, faces, weights, int(samples), behind, slack, out);
  });
  // (N,) how many points each body has, and the rows of them all, body by body.
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
  // `sources`: (to, shift, back, back_shift, quads, inverse depth or None) of each.
  using Source = std::tuple<std::array<float, 9>, std::array<float, 3>, std::array<float, 9>, std::array<float, 3>,
                            In<uint32_t>, std::optional<In<float>>>;
  m.def("patch_match", [](In<uint8_t> grey, std::array<float, 4> lens, std::array<float, 2> range, float noise,
                          uint32_t seed, const std::vector<Source>& sources, int first, int count, Out<float> plane,
                          Out<float> cost, Out<uint8_t> chosen) {
    if (grey.ndim() != 2 || grey.size() == 0) throw std::invalid_argument("grey has to have shape (H, W)");
    if (sources.empty() || sources.size() > linprim::kMostSources) throw std::invalid_argument("wanted 1 to 8 sources");
    const int64_t height = int64_t(grey.shape(0)), width = int64_t(grey.shape(1));
    linprim::PatchMatch match{};
    match.width = int(width), match.height = int(height), match.sources = int(sources.size());
    match.grey = grey.data(), match.noise = noise, match.seed = seed;
    match.focal_x = lens[0], match.focal_y = lens[1], match.center_x = lens[2], match.center_y = lens[3];
    match.least = range[0], match.most = range[1];
    if (!(lens[0] > 0 && lens[1] > 0 && range[0] >= 0 && range[1] > range[0] && noise > 0))
      throw std::invalid_argument("focal lengths, the range of inverse depths or the noise are not positive");
    for (size_t v = 0; v < sources.size(); ++v) {
      const auto& [to, shift, back, back_shift, quads, inverse_depth] = sources[v];
      linprim::StereoSource& source = match.source[v];
      std::copy_n(to.data(), 9, source.to), std::copy_n(shift.data(), 3, source.shift);
      std::copy_n(back.data(), 9, source.back), std::copy_n(back_shift.data(), 3, source.back_shift);
      if (quads.ndim() != 2 || quads.shape(0) < 2 || quads.shape(1) < 2)
        throw std::invalid_argument("quads have to have shape (H, W) of 2 at least");
      source.height = int(quads.shape(0)), source.width = int(quads.shape(1)), source.quads = quads.data();
      if (inverse_depth) source.inverse_depth = checked(*inverse_depth, {source.height, source.width}, "inverse_depth");
    }
    match.plane = checked(plane, {height, width, 3}, "plane"), match.cost = checked(cost, {height, width}, "cost");
    match.chosen = checked(chosen, {height, width}, "chosen");
    nb::gil_scoped_release release;
    linprim::patch_match_begin(match);
    for (int number = first; number < first + count; ++number) linprim::patch_match_iterate(match, number);
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
  m.def("photometric_loss",
        [](In<float> image, In<float> target, std::optional<In<float>> weight, float dssim, Out<float> gradient) {
          if (image.ndim() != 3) throw std::invalid_argument("image has to have shape (3, H, W)");
          const int64_t height = int64_t(image.shape(1)), width = int64_t(image.shape(2));
          const float* a = checked(image, {3, height, width}, "image");
          const float* b = checked(target, {3, height, width}, "target");
          const float* w = weight ? checked(*weight, {height, width}, "weight") : nullptr;
          float* g = checked(gradient, {3, height, width}, "gradient");
          if (height < 1 || width < 1) throw std::invalid_argument("the image is empty");
          linprim::Photometric result;
          {
            nb::gil_scoped_release release;
            result = linprim::photometric_loss(a, b, w, int(width), int(height), dssim, g);
          }
          return std::make_tuple(result.loss, result.l1, result.ssim, result.mse);
        });
  m.def("adam_step", [](Out<float> value, In<float> gradient, Out<float> first, Out<float> second, float rate,
                        float beta1, float beta2, float epsilon, int64_t step) {
    const int64_t n = int64_t(value.size());
    if (int64_t(gradient.size()) != n || int64_t(first.size()) != n || int64_t(second.size()) != n)
      throw std::invalid_argument("value, gradient and moments differ in size");
    if (step < 1) throw std::invalid_argument("step counts from 1");
    float *v = value.data(), *m1 = first.data(), *m2 = second.data();
    const float* g = gradient.data();
    nb::gil_scoped_release release;
    linprim::adam_step(v, g, m1, m2, n, rate, beta1, beta2, epsilon, step);
  });
  m.def(
      "adam_rows", [](std::vector<Out<float>> values, std::vector<In<float>> gradients, std::vector<Out<float>> firsts,
                      std::vector<Out<float>> seconds, std::vector<float> rates, Out<int32_t> steps,
                      std::optional<In<uint8_t>> touched, float beta1, float beta2, float epsilon) {
        const size_t count = values.size();
        if (gradients.size() != count || firsts.size() != count || seconds.size() != count || rates.size() != count)
          throw std::invalid_argument("there have to be as many gradients, moments and rates as values");
        const int64_t n = int64_t(steps.size());
        if (touched && int64_t(touched->size()) != n) throw std::invalid_argument("touched and steps differ in size");
        if (!(beta1 >= 0 && beta1 < 1 && beta2 >= 0 && beta2 < 1))
          throw std::invalid_argument("beta1 and beta2 have to be in [0, 1)");
        std::vector<linprim::RowTensor> tensors;
        for (size_t i = 0; i < count; ++i) {
          const int64_t size = int64_t(values[i].size());
          if (int64_t(gradients[i].size()) != size || int64_t(firsts[i].size()) != size ||
              int64_t(seconds[i].size()) != size)
            throw std::invalid_argument("value, gradient and moments differ in size");
          if (n ? size % n != 0 : size != 0)
            throw std::invalid_argument("a value does not have as many rows as there are steps");
          tensors.push_back(
              {values[i].data(), firsts[i].data(), seconds[i].data(), gradients[i].data(), n ? size / n : 0, rates[i]});
        }
        int32_t* counts = steps.data();
        const uint8_t* rows = touched ? touched->data() : nullptr;
        nb::gil_scoped_release release;
        linprim::adam_rows(tensors.data(), int(count), n, rows, counts, beta1, beta2, epsilon);
      });
  m.def("set_threads", &linprim::set_threads);
  m.def("threads", &linprim::threads);
  m.def("set_instruction_set", [](const std::string& name) { return linprim::set_instruction_set(name.c_str()); });
  m.def("instruction_set", [] { return std::string(linprim::instruction_set()); });
  m.def("limits", [] {
    linprim::Limits limits;
    {
      nb::gil_scoped_release release;
      limits = linprim::measure_limits();
    }
    nb::dict d;
    d["fma_gflops"] = limits.fma_gflops, d["exp_ns"] = limits.exp_ns;
    d["pair_forward_ns"] = limits.pair_forward_ns, d["pair_backward_ns"] = limits.pair_backward_ns;
    return d;
  });
  m.def("statistics", [] {
    const linprim::Statistics s = linprim::statistics();
    nb::dict d;
    d["primitives"] = s.primitives, d["visible"] = s.visible, d["pairs"] = s.pairs;
    d["visited_lanes"] = s.visited_lanes, d["hit_lanes"] = s.hit_lanes, d["working_set_bytes"] = s.working_set_bytes;
    d["project_ms"] = s.project_ms, d["sort_ms"] = s.sort_ms, d["bin_ms"] = s.bin_ms, d["forward_ms"] = s.forward_ms;
    d["backward_ms"] = s.backward_ms, d["chain_ms"] = s.chain_ms;
    return d;
  });
}
