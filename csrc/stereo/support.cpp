#include "stereo/support.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <vector>

#include "base/parallel.h"

namespace linprim {
namespace {

// How many pixels from `at` on, every `step`, are like it; no more than `most`.
int arm(const uint8_t* grey, int64_t at, int64_t step, int most) {
  int length = 0;
  while (length < most && std::abs(grey[at + (length + 1) * step] - grey[at]) < kCrossGrey) ++length;
  return length;
}

}  // namespace

void support(const uint8_t* grey, const float* plane, int height, int width, float tolerance, float* share) {
  const int64_t pixels = int64_t(height) * width;
  std::vector<uint8_t> left(pixels), right(pixels);
  parallel_for(height, [&](int64_t row, int) {
    for (int column = 0; column < width; ++column) {
      const int64_t at = row * width + column;
      left[at] = uint8_t(arm(grey, at, -1, std::min(kCrossReach, column)));
      right[at] = uint8_t(arm(grey, at, 1, std::min(kCrossReach, width - 1 - column)));
    }
  });
  const float *right_slope = plane + pixels, *down_slope = plane + 2 * pixels;
  parallel_for(height, [&](int64_t row, int) {
    for (int column = 0; column < width; ++column) {
      const int64_t at = row * width + column;
      share[at] = 0;
      if (!(plane[at] > 0)) continue;
      const int up = arm(grey, at, -width, std::min(kCrossReach, int(row)));
      const int down = arm(grey, at, width, std::min(kCrossReach, height - 1 - int(row)));
      int all = 0, alike = 0;
      for (int y = -up; y <= down; ++y) {
        const int64_t middle = at + int64_t(y) * width;
        for (int x = -left[middle]; x <= right[middle]; ++x) {
          const int64_t other = middle + x;
          const float here = plane[at] + right_slope[at] * float(x) + down_slope[at] * float(y);
          const float back = plane[other] - right_slope[other] * float(x) - down_slope[other] * float(y);
          const bool continues = std::abs(plane[other] - here) < tolerance * here;
          const bool is_continued = std::abs(plane[at] - back) < tolerance * back;
          alike += plane[other] > 0 && (continues || is_continued);
        }
        all += left[middle] + right[middle] + 1;
      }
      share[at] = float(alike) / float(all);
    }
  });
}

}  // namespace linprim
