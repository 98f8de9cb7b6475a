// Collects the best colour samples of surface points from photographs.
#pragma once

#include <cstdint>

#include "surface/photo_view.h"

namespace linprim {

constexpr int kKeptSamples = 8;  // per point

struct ColorRules {
  double slack;         // a point may lie this far behind the surface of its pixel, at least a footprint
  double least_facing;  // samples at a flatter angle (cosine) are poor
  double poor_share;    // factor on the weight of poor samples
  double opaque;        // samples with less alpha than this are poor
};

struct ColorSamples {
  int64_t count;
  const double* point;   // (count, 3)
  const double* normal;  // (count, 3) unit length
  float* best;           // (count, kKeptSamples) weights, descending, 0 for none
  float* shade;          // (count, kKeptSamples, 3)
  uint8_t* good;         // (count) whether a sample is not poor
};

// Adds one photograph of three channels, or of four with alpha from 0 to 255, by which the others are premultiplied;
// samples with less than half of full alpha are dropped. `near` and `far` (height, width) are the least and the largest
// depth of 3x3 pixels.
//
// The weight of a sample is the cosine over the square of the pixel's footprint there. A sample is poor on an outline,
// or at too flat an angle.
void add_colors(const PhotoView& view, const float* near, const float* far, const ColorRules& rules,
                const ColorSamples& samples);

}  // namespace linprim
