#include "surface/face_samples.h"

#include "base/parallel.h"

namespace linprim {
namespace {

// Returns whether a point lies in the image and is not farther away than (1 + behind) d + slack, with d the largest
// depth of the four pixels around it.
bool maybe_seen(const PhotoView& view, const double* point, double behind, double slack) {
  double at[3];
  to_camera(view, point, at);
  const double z = at[2];
  if (!(z > 0)) return false;
  const double u = at[0] / z * view.fx + view.cx, v = at[1] / z * view.fy + view.cy;
  if (!(u >= 0 && u < view.width && v >= 0 && v < view.height)) return false;
  const int j = std::max(int(u - 0.5), 0), i = std::max(int(v - 0.5), 0);
  const int right = std::min(j + 1, view.width - 1), below = std::min(i + 1, view.height - 1);
  const float *top = view.depth + int64_t(i) * view.width, *bottom = view.depth + int64_t(below) * view.width;
  const double farthest = std::max(std::max(top[j], top[right]), std::max(bottom[j], bottom[right]));
  return z <= farthest * (1 + behind) + slack;
}

}  // namespace

void face_samples(const PhotoView& view, const Faces& faces, const double* bary, int samples, double behind,
                  double slack, uint8_t* found) {
  for_rows(faces.count, [&](int64_t f) {
    found[f] = 0;
    if (faces.skip[f]) return;
    const int64_t* corner = faces.corner + 3 * f;
    const double *a = faces.vertex + 3 * corner[0], *b = faces.vertex + 3 * corner[1],
                 *c = faces.vertex + 3 * corner[2];
    for (int s = 0; s < samples; ++s) {
      const double* w = bary + 3 * s;
      double point[3];
      for (int k = 0; k < 3; ++k) point[k] = w[0] * a[k] + w[1] * b[k] + w[2] * c[k];
      if (maybe_seen(view, point, behind, slack)) found[f] |= uint8_t(1 << s);
    }
  });
}

}  // namespace linprim
