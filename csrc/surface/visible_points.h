// Projects points into the image of a pinhole camera.
#pragma once

#include <cstdint>
#include <vector>

#include "surface/photo_view.h"

namespace linprim {

// Column and row, with the centre of the first pixel at (0.5, 0.5), and depth along the optical axis.
struct ImagePlace {
  double column, row, depth;
};

inline ImagePlace place_of(const PhotoView& view, const double* point) {
  double at[3];
  to_camera(view, point, at);
  const double scale = 1 / at[2];
  return {at[0] * scale * view.fx + view.cx, at[1] * scale * view.fy + view.cy, at[2]};
}

// Returns whether a place is in front of the camera and in the image; false if it is not a number.
inline bool is_visible(const PhotoView& view, const ImagePlace& at) {
  return at.depth > 0 && at.column >= 0 && at.row >= 0 && at.column < view.width && at.row < view.height;
}

struct VisiblePoints {
  std::vector<double> place;  // (.., 2) columns and rows
  std::vector<double> depth;
};

// Returns the visible ones of `point` (count, 3), in their order; sets inside[count] to whether each is visible.
// Float64. The image and depth of the view are not used. The result is the same for any number of threads.
VisiblePoints visible_points(const PhotoView& view, const double* point, int64_t count, uint8_t* inside);

}  // namespace linprim
