// A pinhole photograph of a surface, and projection of surface points into it.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

namespace linprim {

// Pixel centres at +0.5. Arrays are (height, width).
struct PhotoView {
  double pose[12];  // world to camera, 3 rows of 4
  double fx, fy, cx, cy;
  int width, height;
  const float* image;  // (height, width, channels)
  int channels;
  const float* depth;  // z of the surface
};

// Writes the camera coordinates of a point.
inline void to_camera(const PhotoView& view, const double* point, double* at) {
  for (int r = 0; r < 3; ++r) {
    const double* row = view.pose + 4 * r;
    at[r] = row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + row[3];
  }
}

// A point and its normal in camera coordinates, the cosine between the normal and the direction to the camera, and the
// point's pixel coordinates.
struct SeenPoint {
  double at[3], normal[3], facing, u, v;

  int64_t pixel(int width) const { return int64_t(v) * width + int64_t(u); }
};

// Projects a point. Returns false if it is behind the camera, seen at a flatter angle than `least_cosine`, or outside
// of the image.
inline bool look(const PhotoView& view, double least_cosine, const double* point, const double* normal,
                 SeenPoint& out) {
  to_camera(view, point, out.at);
  for (int r = 0; r < 3; ++r) {
    const double* row = view.pose + 4 * r;
    out.normal[r] = row[0] * normal[0] + row[1] * normal[1] + row[2] * normal[2];
  }
  const double *at = out.at, z = at[2];
  if (!(z > 0)) return false;
  const double length = std::sqrt(at[0] * at[0] + at[1] * at[1] + z * z);
  out.facing = -(at[0] * out.normal[0] + at[1] * out.normal[1] + z * out.normal[2]) / length;
  if (!(out.facing > least_cosine)) return false;
  out.u = at[0] / z * view.fx + view.cx, out.v = at[1] / z * view.fy + view.cy;
  return out.u >= 0 && out.u < view.width && out.v >= 0 && out.v < view.height;
}

// Returns the change of a plane's depth from one pixel to the next: a pixel's footprint times the tangent of the
// viewing angle, whose cosine is taken as at least `least_facing`.
inline double slope_across(double footprint, double facing, double least_facing) {
  const double cosine = std::max(facing, least_facing);
  return footprint * std::sqrt(1 / (cosine * cosine) - 1);
}

// Writes the channels at (u, v), bilinearly interpolated, and clamped beyond the outermost pixel centres.
inline void bilinear(const PhotoView& view, double u, double v, float* out) {
  const double x = std::clamp(u - 0.5, 0.0, double(view.width - 1)),
               y = std::clamp(v - 0.5, 0.0, double(view.height - 1));
  const int j = std::min(int(x), std::max(view.width - 2, 0)), i = std::min(int(y), std::max(view.height - 2, 0));
  const int right = std::min(j + 1, view.width - 1), below = std::min(i + 1, view.height - 1), n = view.channels;
  const float a = float(x - j), b = float(y - i);
  const float* top = view.image + int64_t(i) * view.width * n;
  const float* bottom = view.image + int64_t(below) * view.width * n;
  for (int c = 0; c < n; ++c) {
    const float above = top[j * n + c] + a * (top[right * n + c] - top[j * n + c]);
    const float under = bottom[j * n + c] + a * (bottom[right * n + c] - bottom[j * n + c]);
    out[c] = above + b * (under - above);
  }
}

}  // namespace linprim
