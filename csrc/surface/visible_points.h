// Where points lie in the image of a pinhole camera.
#pragma once

#include <cstdint>
#include <vector>

#include "surface/photo_view.h"

namespace linprim {

// Column and row, the middle of the first pixel being (0.5, 0.5), and depth along the optical axis.
struct ImagePlace {
  double column, row, depth;
};

inline ImagePlace place_of(const PhotoView& view, const double* point) {
  double at[3];
  to_camera(view, point, at);
  const double scale = 1 / at[2];
  return {at[0] * scale * view.fx + view.cx, at[1] * scale * view.fy + view.cy, at[2]};
}

// Whether a place is in front of the camera and in the image; not where it is no number.
inline bool is_visible(const PhotoView& view, const ImagePlace& at) {
  return at.depth > 0 && at.column >= 0 && at.row >= 0 && at.column < view.width && at.row < view.height;
}

struct VisiblePoints {
  std::vector<double> place;  // (.., 2) columns and rows
  std::vector<double> depth;
};

// The visible ones of `point` (count, 3), in their order; sets inside[count] to whether each is. Float64. Of the view
// image and depth are not looked at. The same for any number of threads.
VisiblePoints visible_points(const PhotoView& view, const double* point, int64_t count, uint8_t* inside);

}  // namespace linprim
