// Cross-shaped regions: the pixels around each pixel that no edge of the photograph separates from it.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <vector>

#include "base/parallel.h"

namespace linprim {

// kCrossReach: largest length of a cross's arms in pixels, about twice as far as a window of PatchMatch extends a
// surface beyond its edge. kCrossGrey: difference in grey values that ends an arm; up and down it is measured from the
// centre pixel, to the sides from the pixel in the middle of the row.
constexpr int kCrossReach = 10, kCrossGrey = 25;

// For every pixel of a photograph, the similar pixels up and down, and to the left and right of each of these. Source:
// Zhang, Lu, Lafruit 2009, cross-based local stereo matching.
class Crosses {
 public:
  Crosses(const uint8_t* grey, int height, int width) : width_(width), arms_(int64_t(height) * width) {
    parallel_for(height, [&](int64_t row, int) {
      for (int column = 0; column < width; ++column) {
        const uint8_t* at = grey + row * width + column;
        arms_[at - grey] = {arm(at, -1, column), arm(at, 1, width - 1 - column), arm(at, -width, int(row)),
                            arm(at, width, height - 1 - int(row))};
      }
    });
  }

  // Calls body(at) for every pixel, on several threads.
  template <class Body>
  void for_each_pixel(Body body) const {
    parallel_for(int64_t(arms_.size()) / width_, [&](int64_t row, int) {
      for (int64_t at = row * width_; at < (row + 1) * width_; ++at) body(at);
    });
  }

  // Calls body(y, pixel in row y above or below the pixel `at`, arm lengths to its left and right) for each row of the
  // cross.
  template <class Body>
  void for_each_row(int64_t at, Body body) const {
    for (int y = -arms_[at].up; y <= arms_[at].down; ++y) {
      const int64_t middle = at + int64_t(y) * width_;
      body(y, middle, int(arms_[middle].left), int(arms_[middle].right));
    }
  }

 private:
  struct Arms {
    uint8_t left, right, up, down;
  };

  // Returns how many pixels after `at`, at distances of `step`, are similar to it.
  static uint8_t arm(const uint8_t* at, int64_t step, int room) {
    const int most = std::min(kCrossReach, room);
    int length = 0;
    while (length < most && std::abs(at[(length + 1) * step] - *at) < kCrossGrey) ++length;
    return uint8_t(length);
  }

  int width_;
  std::vector<Arms> arms_;
};

}  // namespace linprim
