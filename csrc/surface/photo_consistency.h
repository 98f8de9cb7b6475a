// Samples the brightness of photographs along the normals of surface points, to compare it over the photographs.
#pragma once

#include <cstdint>

#include "surface/photo_view.h"

namespace linprim {

// A photograph sees a point well if the cosine between the point's normal and the direction to the camera is above
// `least_cosine`, the point is behind the surface of its pixel by no more than its slope explains, and the depth jump
// of the pixel is no more than `outline_slopes` times that.
struct PhotoRules {
  double least_cosine, outline_slopes;
};

// Sums over photographs for `count` points. `footprint` is the unit of the offsets along the normal.
struct PhotoSums {
  int64_t count;
  const double* point;      // (count, 3)
  const double* normal;     // (count, 3) unit length
  const double* footprint;  // (count)
  int32_t* views;           // (count) number of photographs that see it well
  float* weight;            // (count) sum of the cosines
  float* value;             // (count, offsets) sum of cosine times brightness
  float* square;            // (count, offsets) sum of cosine times brightness squared
};

// Adds one photograph of one channel, brightness. `jump` (height, width) is the largest minus the least depth of 3x3
// pixels.
void add_photo(const PhotoView& view, const float* jump, const PhotoRules& rules, const double* offset, int offsets,
               const PhotoSums& sums);

// Lowers `least` of each of `count` points to the footprint of a pixel of this view at the point, if the cosine of the
// viewing angle is above `least_cosine` and the point lies in the image. Only the pose, the lens and the size of the
// view are used.
void least_footprints(const PhotoView& view, double least_cosine, const double* point, const double* normal,
                      int64_t count, double* least);

}  // namespace linprim
