// Bindings of PatchMatch stereo, the support of its planes, surface fitting, plane fitting by shading in plain regions,
// and votes of rays for tetrahedra.
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <optional>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "bind/arrays.h"
#include "bind/parts.h"
#include "stereo/cell_votes.h"
#include "stereo/fit_surfaces.h"
#include "stereo/patch_match.h"
#include "stereo/shading.h"
#include "stereo/support.h"

void bind_stereo(nb::module_& m) {
  // One element of `sources`: (to, shift, back, back_shift, quads, inverse depth or None), see StereoSource.
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

  m.def("support", [](In<uint8_t> grey, In<float> plane, float tolerance, Out<float> share) {
    if (grey.ndim() != 2 || grey.size() == 0) throw std::invalid_argument("grey has to have shape (H, W)");
    const int64_t height = int64_t(grey.shape(0)), width = int64_t(grey.shape(1));
    const float* planes = checked(plane, {3, height, width}, "plane");
    float* result = checked(share, {height, width}, "share");
    nb::gil_scoped_release release;
    linprim::support(grey.data(), planes, int(height), int(width), tolerance, result);
  });

  m.def("fit_surfaces", [](In<uint8_t> grey, In<float> plane, In<float> cost, float tolerance, Out<float> fitted,
                           Out<float> fitted_cost) {
    if (grey.ndim() != 2 || grey.size() == 0) throw std::invalid_argument("grey has to have shape (H, W)");
    if (!(tolerance > 0 && tolerance < 1)) throw std::invalid_argument("tolerance has to be between 0 and 1");
    const int64_t height = int64_t(grey.shape(0)), width = int64_t(grey.shape(1));
    const float* planes = checked(plane, {3, height, width}, "plane");
    const float* costs = checked(cost, {height, width}, "cost");
    float* result = checked(fitted, {3, height, width}, "fitted");
    float* result_cost = checked(fitted_cost, {height, width}, "fitted_cost");
    nb::gil_scoped_release release;
    linprim::fit_surfaces(grey.data(), planes, costs, int(height), int(width), tolerance, result, result_cost);
  });

  m.def("compare_shading", [](In<double> rays, In<double> value, std::array<double, 3> plane, In<double> turn,
                              std::array<double, 3> shift, std::array<double, 4> lens, In<float> means,
                              In<uint8_t> plain, In<double> moves, int64_t least, Out<uint8_t> shown, Out<double> left,
                              Out<double> information, Out<double> downhill) {
    if (means.ndim() != 3) throw std::invalid_argument("means have to have shape (H, W, 3)");
    const int64_t boxes = int64_t(value.size()), height = int64_t(means.shape(0)), width = int64_t(means.shape(1));
    linprim::ShadedPair pair{};
    pair.boxes = boxes, pair.height = int(height), pair.width = int(width), pair.least = least;
    pair.rays = checked(rays, {boxes, 3}, "rays"), pair.value = checked(value, {boxes}, "value");
    pair.means = checked(means, {height, width, 3}, "means"), pair.plain = checked(plain, {height, width}, "plain");
    std::copy_n(plane.data(), 3, pair.plane), std::copy_n(shift.data(), 3, pair.shift);
    std::copy_n(checked(turn, {3, 3}, "turn"), 9, pair.turn),
        std::copy_n(checked(moves, {3, 3}, "moves"), 9, pair.moves);
    pair.focal_x = lens[0], pair.focal_y = lens[1], pair.center_x = lens[2], pair.center_y = lens[3];
    uint8_t* is_shown = checked(shown, {boxes}, "shown");
    double* rest = checked(left, {boxes}, "left");
    double *matrix = checked(information, {3, 3}, "information"), *right = checked(downhill, {3}, "downhill");
    nb::gil_scoped_release release;
    const linprim::ShadedComparison found = linprim::compare_shading(pair, is_shown, rest);
    std::copy_n(found.information, 9, matrix), std::copy_n(found.downhill, 3, right);
    return std::tuple(found.boxes, found.left_variance, found.variance);
  });

  m.def("vote_for_cells", [](In<double> point, In<int32_t> corner, In<int32_t> neighbor, int32_t start,
                             In<int32_t> around, In<double> ray, double empty, double full, Out<int64_t> votes) {
    const int64_t points = int64_t(point.size()) / 3, cells = int64_t(corner.size()) / 4;
    const int64_t rays = int64_t(ray.size()) / 3, count = int64_t(around.size());
    const linprim::Cells mesh{cells, checked(point, {points, 3}, "point"),
                              rows_of(corner, {cells, 4}, points, "corner", "points"),
                              rows_of(neighbor, {cells, 4}, cells, "neighbor", "cells", -1)};
    if (start < 0 || start >= points) throw std::invalid_argument("there is no such point to start from");
    const int32_t* first = rows_of(around, {count}, cells, "around", "cells");
    const double* directions = checked(ray, {rays, 3}, "ray");
    int64_t* counted = checked(votes, {cells + 1}, "votes");
    nb::gil_scoped_release release;
    linprim::vote_for_cells(mesh, start, count, first, rays, directions, empty, full, counted);
  });
}
