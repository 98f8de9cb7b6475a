#include "surface/first_hits.h"

#include <atomic>
#include <bit>
#include <cmath>
#include <limits>
#include <vector>

#include "base/parallel.h"
#include "surface/face_normals.h"

namespace linprim {
namespace {

// Margin in pixels around the bounding box of a face: more than the rounding errors of float in images of 16,000
// pixels.
constexpr float kRoom = 1e-3f;

// Pixel coordinates of a vertex; NaN behind the camera.
struct Place {
  float u = NAN, v = NAN;
};

// Columns or rows first .. end - 1.
struct Range {
  int first, end;
};

// Returns the columns or rows, of `size`, whose pixel centres lie between `low` and `high`. Does not use std::floor,
// for which old processors have no instruction.
Range centers(float low, float high, int size) {
  const float last = std::min(high - 0.5f + kRoom, float(size - 1)), first = std::max(low - 0.5f - kRoom, 0.0f);
  if (!(first <= last)) return {0, 0};
  const int number = int(first);
  return {number + (float(number) < first), int(last) + 1};
}

// Rasterizes faces into a depth buffer. Several threads may call draw() at the same time.
class Drawing {
 public:
  Drawing(const PhotoView& view, int64_t vertices, const double* vertex, const int64_t* corner)
      : view_(view), corner_(corner), place_(vertices), at_(vertices), nearest_(int64_t(view.width) * view.height) {
    for_rows(vertices, [&](int64_t v) {
      to_camera(view, vertex + 3 * v, at_[v].data());
      const auto [x, y, z] = at_[v];
      if (z > 0) place_[v] = {float(x / z * view.fx + view.cx), float(y / z * view.fy + view.cy)};
    });
    for (auto& pixel : nearest_) pixel.store(kNothing, std::memory_order_relaxed);
  }

  // Draws a face: tests the pixel centres in its bounding box, or in the whole image if it reaches behind the camera.
  void draw(int64_t face) {
    const int64_t* corner = corner_ + 3 * face;
    const Place &p = place_[corner[0]], &q = place_[corner[1]], &r = place_[corner[2]];
    Range columns{0, view_.width}, rows{0, view_.height};
    const bool before = !std::isnan(p.u + q.u + r.u);
    if (before) {
      columns = centers(std::min({p.u, q.u, r.u}), std::max({p.u, q.u, r.u}), view_.width);
      rows = centers(std::min({p.v, q.v, r.v}), std::max({p.v, q.v, r.v}), view_.height);
      if (columns.first >= columns.end || rows.first >= rows.end) return;
    }
    const Vector &a = at_[corner[0]], &b = at_[corner[1]], &c = at_[corner[2]];
    if (!before && beside(a, b, c)) return;
    // Edge functions: a ray hits the face if its products with all three have the sign of the volume.
    const Vector sides[3] = {cross(a, b), cross(b, c), cross(c, a)};
    const double volume = dot(sides[0], c), sign = volume < 0 ? -1 : 1;
    if (!(sign * volume > 0)) return;
    for (int y = rows.first; y < rows.end; ++y)
      for (int x = columns.first; x < columns.end; ++x) {
        const Vector ray{(x + 0.5 - view_.cx) / view_.fx, (y + 0.5 - view_.cy) / view_.fy, 1};
        const double ab = sign * dot(sides[0], ray), bc = sign * dot(sides[1], ray), ca = sign * dot(sides[2], ray);
        if (!(ab >= 0 && bc >= 0 && ca >= 0 && ab + bc + ca > 0)) continue;
        offer(int64_t(y) * view_.width + x, float(sign * volume / (ab + bc + ca)), face);
      }
  }

  // Writes depth and face of every pixel.
  void write(float* depth, int32_t* face) const {
    for (size_t pixel = 0; pixel < nearest_.size(); ++pixel) {
      const uint64_t found = nearest_[pixel].load(std::memory_order_relaxed);
      const bool hit = found != kNothing;
      depth[pixel] = hit ? std::bit_cast<float>(uint32_t(found >> 32)) : std::numeric_limits<float>::infinity();
      face[pixel] = hit ? int32_t(found & UINT32_MAX) : -1;
    }
  }

 private:
  static constexpr uint64_t kNothing = UINT64_MAX;  // no face yet

  // Returns whether a face that is not entirely in front of the camera lies behind it or outside of one side of the
  // view frustum.
  bool beside(const Vector& a, const Vector& b, const Vector& c) const {
    const auto all = [&](double x, double y, double z) {
      const Vector side{x, y, z};
      return dot(side, a) < 0 && dot(side, b) < 0 && dot(side, c) < 0;
    };
    return (a[2] <= 0 && b[2] <= 0 && c[2] <= 0) || all(view_.fx, 0, view_.cx) || all(0, view_.fy, view_.cy) ||
           all(-view_.fx, 0, view_.width - view_.cx) || all(0, -view_.fy, view_.height - view_.cy);
  }

  // Keeps the nearer face of a pixel, and of equally near ones the one with the lower number. Compares bits: those of
  // depths that are not negative have the same order as the depths.
  void offer(int64_t pixel, float depth, int64_t face) {
    const uint64_t own = uint64_t(std::bit_cast<uint32_t>(depth)) << 32 | uint64_t(face);
    uint64_t least = nearest_[pixel].load(std::memory_order_relaxed);
    while (own < least && !nearest_[pixel].compare_exchange_weak(least, own, std::memory_order_relaxed)) {
    }
  }

  const PhotoView& view_;
  const int64_t* corner_;
  std::vector<Place> place_;
  std::vector<Vector> at_;                      // camera coordinates of the vertices
  std::vector<std::atomic<uint64_t>> nearest_;  // bits of the depth, then the face
};

}  // namespace

void first_hits(const PhotoView& view, int64_t vertices, const double* vertex, int64_t faces, const int64_t* corner,
                float* depth, int32_t* face) {
  Drawing drawing(view, vertices, vertex, corner);
  for_rows(faces, [&](int64_t f) { drawing.draw(f); });
  drawing.write(depth, face);
}

}  // namespace linprim
