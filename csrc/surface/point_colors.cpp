#include "surface/point_colors.h"

#include "base/parallel.h"

namespace linprim {
namespace {

// A sample is on an outline if the depth around its pixel jumps by more than kOutlineSlopes slopes, or if the point
// lies more than kBehindSlopes slopes behind the nearest depth around it.
constexpr double kOutlineSlopes = 4, kBehindSlopes = 2;

// Adds the sample of one point to its kKeptSamples best ones, if the photograph sees the point.
void add_color(const PhotoView& view, const float* near, const float* far, const ColorRules& rules,
               const ColorSamples& samples, int64_t p) {
  SeenPoint seen;
  if (!look(view, 0, samples.point + 3 * p, samples.normal + 3 * p, seen)) return;
  const int64_t pixel = seen.pixel(view.width);
  const double z = seen.at[2], step = z / std::min(view.fx, view.fy);
  const double slope = std::max(rules.slack, step) + slope_across(step, seen.facing, rules.least_facing);
  if (!(z <= view.depth[pixel] + slope)) return;
  bool poor = double(far[pixel]) - near[pixel] > kOutlineSlopes * slope || z > near[pixel] + kBehindSlopes * slope ||
              seen.facing < rules.least_facing;
  float color[4];
  bilinear(view, seen.u, seen.v, color);
  if (view.channels == 4) {
    const float alpha = color[3] / 255;
    if (!(alpha >= 0.5f)) return;
    poor |= alpha < rules.opaque;
    for (int c = 0; c < 3; ++c) color[c] /= alpha;
  }
  const float weight = float(std::max(seen.facing, rules.least_facing * rules.least_facing) / (step * step) *
                             (poor ? rules.poor_share : 1));
  if (!poor) samples.good[p] = 1;
  float *best = samples.best + p * kKeptSamples, *shade = samples.shade + p * kKeptSamples * 3;
  int slot = kKeptSamples;
  while (slot > 0 && best[slot - 1] < weight) --slot;  // equal ones stay in the order of the photographs
  if (slot == kKeptSamples) return;
  std::copy_backward(best + slot, best + kKeptSamples - 1, best + kKeptSamples);
  std::copy_backward(shade + 3 * slot, shade + 3 * (kKeptSamples - 1), shade + 3 * kKeptSamples);
  best[slot] = weight;
  std::copy_n(color, 3, shade + 3 * slot);
}

}  // namespace

void add_colors(const PhotoView& view, const float* near, const float* far, const ColorRules& rules,
                const ColorSamples& samples) {
  for_rows(samples.count, [&](int64_t p) { add_color(view, near, far, rules, samples, p); });
}

}  // namespace linprim
