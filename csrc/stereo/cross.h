// Which pixels around one belong to it: those that no edge of the photograph parts from it.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <vector>

#include "base/parallel.h"

namespace linprim {

// A cross reaches so many pixels in each direction, about twice as far as a window of PatchMatch holds a surface beyond
// its edge. Up and down it ends where grey values differ from the pixel's by this much, and to the sides where they do
// from those of the pixel in the middle of the row.
constexpr int kCrossReach = 10, kCrossGrey = 25;

// Of every pixel of a photograph the pixels alike up and down, and to the left and right of each of these. Source:
// Zhang, Lu, Lafruit 2009, cross-based local stereo matching.
class Crosses {
 public:
  Crosses(const uint8_t* grey, int height, int width) : grey_(grey), height_(height), width_(width) {
    left_.resize(int64_t(height) * width), right_.resize(left_.size());
    parallel_for(height, [&](int64_t row, int) {
      for (int column = 0; column < width; ++column) {
        const int64_t at = row * width + column;
        left_[at] = uint8_t(arm(at, -1, column));
        right_[at] = uint8_t(arm(at, 1, width - 1 - column));
      }
    });
  }

  // How far the cross of a pixel reaches in its own row and column.
  int left(int64_t at) const { return left_[at]; }
  int right(int64_t at) const { return right_[at]; }
  int up(int64_t at) const { return arm(at, -width_, int(at / width_)); }
  int down(int64_t at) const { return arm(at, width_, height_ - 1 - int(at / width_)); }

 private:
  int arm(int64_t at, int64_t step, int room) const {
    const int most = std::min(kCrossReach, room);
    int length = 0;
    while (length < most && std::abs(grey_[at + (length + 1) * step] - grey_[at]) < kCrossGrey) ++length;
    return length;
  }

  const uint8_t* grey_;
  int height_, width_;
  std::vector<uint8_t> left_, right_;
};

}  // namespace linprim
