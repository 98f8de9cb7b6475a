// Brightness of photographs along the normals of surface points: what they say of where the surface is.
#pragma once

#include <cstdint>

#include "surface/photo_view.h"

namespace linprim {

// A point is looked at where the cosine between its normal and the direction to the camera is above `least_cosine`, its
// depth is no more than what its slope explains behind that of the surface, and the jump of its pixel is no more than
// `outline_slopes` times that.
struct PhotoRules {
  double least_cosine, outline_slopes;
};

// Sums over photographs per point, of `count` points. `footprint` is the unit of the offsets along the normal.
struct PhotoSums {
  int64_t count;
  const double* point;      // (count, 3)
  const double* normal;     // (count, 3) unit length
  const double* footprint;  // (count)
  int32_t* views;           // (count) photographs that see it well
  float* weight;            // (count) sum of the cosines
  float* value;             // (count, offsets) sum of cosine times brightness
  float* square;            // (count, offsets) sum of cosine times brightness squared
};

// Adds one photograph of one channel, brightness; `jump` (height, width) is the largest less least depth of 3x3 pixels.
void add_photo(const PhotoView& view, const float* jump, const PhotoRules& rules, const double* offset, int offsets,
               const PhotoSums& sums);

// Lowers `least` of each of `count` points to what a pixel of this view covers at it, where the view looks onto it
// under more than `least_cosine` and it lies in the image. Only the pose, the lens and the size of the view are used.
void least_footprints(const PhotoView& view, double least_cosine, const double* point, const double* normal,
                      int64_t count, double* least);

}  // namespace linprim
