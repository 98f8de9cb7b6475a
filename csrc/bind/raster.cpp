// Bindings of the rasterizer, its gradients, level depth, pixel averaging and the environment light, per precision.
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

#include "bind/arrays.h"
#include "bind/parts.h"
#include "linprim.h"
#include "raster/environment.h"

namespace {

// Ray model, order, screen filter.
using RasterModel = std::tuple<int, int, double>;

// Returns the view of checked arguments; throws std::invalid_argument.
linprim::View make_view(const Pose& pose, const std::tuple<double, double, double, double>& intrinsics, int width,
                        int height, double near, double stop, double level, const RasterModel& model) {
  linprim::View view{};
  const auto [rays, order, screen_filter] = model;
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

// Returns the primitives of arrays with checked shapes; throws std::invalid_argument.
template <class Real>
linprim::Primitives<Real> make_primitives(int kind, const In<Real>& center, const In<Real>& rotation,
                                          const In<Real>& extent, const In<Real>& density, const In<Real>& sh) {
  const int64_t n = center.ndim() ? int64_t(center.shape(0)) : 0;
  const int64_t count = sh.ndim() == 3 ? int64_t(sh.shape(1)) : 0;
  if (count != 1 && count != 4 && count != 9 && count != 16)
    throw std::invalid_argument("sh has to have shape (N, 1 | 4 | 9 | 16, 3)");
  if (n >= (int64_t(1) << 31)) throw std::invalid_argument("more than 2^31 primitives");
  if (kind < 0 || kind >= linprim::kKinds) throw std::invalid_argument("unknown kind of primitive");
  const int64_t extents = linprim::traits_of(linprim::PrimitiveKind(kind)).extents;
  return {linprim::PrimitiveKind(kind),
          n,
          checked(center, {n, 3}, "center"),
          checked(rotation, {n, 4}, "rotation"),
          checked(extent, {n, extents}, "extent"),
          checked(density, {n}, "density"),
          checked(sh, {n, count, 3}, "sh"),
          int(count)};
}

// Returns the camera as a direction view, with the image size of `opacity` (H, W), and the cube map `map` (6, S, S, 3);
// checks both.
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

// Returns the image planes of arrays with checked shapes, in the order rgb, opacity, depth_expected, depth_median,
// depth_first, distortion, normal, normal_median, state. Missing ones are null.
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

// Throws if a required output plane is missing.
template <class Real>
void require_planes(const linprim::Planes<Real>& p, bool geometry) {
  bool all = p.rgb && p.opacity;
  if (geometry)
    all = all && p.depth_expected && p.depth_median && p.depth_first && p.distortion && p.normal && p.normal_median &&
          p.state;
  if (!all) throw std::invalid_argument("an output plane is missing");
}

// Throws if the primitives' kind does not support the view's blending order.
template <class Real>
void require_kernels(const linprim::View& view, const linprim::Primitives<Real>& primitives) {
  if (!linprim::has_kernels<Real>(primitives.kind, view.rays, view.order))
    throw std::invalid_argument(
        "these primitives cannot be blended in this order: a Gaussian has no entry and no exit");
}

// Defines the functions of one precision; `suffix` ends their names.
template <class Real>
void bind_real(nb::module_& m, const char* suffix) {
  using namespace nb::literals;
  using Array = In<Real>;
  m.def((std::string("rasterize_") + suffix).c_str(),
        [](int kind, Array center, Array rotation, Array extent, Array density, Array sh, Array background, Pose pose,
           std::tuple<double, double, double, double> intrinsics, int width, int height, double near, double stop,
           double level, RasterModel model, bool geometry, std::vector<std::optional<Out<Real>>> planes,
           Out<Real> color, Out<Real> max_weight, Out<int32_t> pixels) {
          const linprim::View view = make_view(pose, intrinsics, width, height, near, stop, level, model);
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
         double level, RasterModel model, bool geometry, std::vector<std::optional<Array>> planes, Array color,
         std::vector<std::optional<Array>> grads, Out<Real> center_grad, Out<Real> rotation_grad, Out<Real> extent_grad,
         Out<Real> density_grad, Out<Real> sh_grad, Out<Real> background_grad, Out<Real> screen_grad) {
        const linprim::View view = make_view(pose, intrinsics, width, height, near, stop, level, model);
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
           RasterModel model, Out<Real> depth, Out<Real> opacity) {
          const linprim::View view = make_view(pose, intrinsics, width, height, near, 0, level, model);
          const auto primitives = make_primitives<Real>(kind, center, rotation, extent, density, sh);
          if (!linprim::is_solid(primitives.kind))
            throw std::invalid_argument("it has no faces, so no entry and no exit");
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

}  // namespace

void bind_raster(nb::module_& m) {
  bind_real<float>(m, "f32");
  bind_real<double>(m, "f64");
}
