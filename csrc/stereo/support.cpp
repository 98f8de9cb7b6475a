#include "stereo/support.h"

#include <cmath>

#include "stereo/cross.h"

namespace linprim {

void support(const uint8_t* grey, const float* plane, int height, int width, float tolerance, float* share) {
  const Crosses crosses(grey, height, width);
  const int64_t pixels = int64_t(height) * width;
  const float *right_slope = plane + pixels, *down_slope = plane + 2 * pixels;
  crosses.for_each_pixel([&](int64_t at) {
    share[at] = 0;
    if (!(plane[at] > 0)) return;
    int all = 0, alike = 0;
    crosses.for_each_row(at, [&](int y, int64_t middle, int left, int right) {
      for (int x = -left; x <= right; ++x) {
        const int64_t other = middle + x;
        // Inverse depth of this pixel's plane at the other pixel, and of the other pixel's plane here.
        const float here = plane[at] + right_slope[at] * float(x) + down_slope[at] * float(y);
        const float back = plane[other] - right_slope[other] * float(x) - down_slope[other] * float(y);
        const bool continues = std::abs(plane[other] - here) < tolerance * here;
        const bool is_continued = std::abs(plane[at] - back) < tolerance * back;
        alike += plane[other] > 0 && (continues || is_continued);
      }
      all += left + right + 1;
    });
    share[at] = float(alike) / float(all);
  });
}

}  // namespace linprim
