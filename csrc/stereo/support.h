// How far the surface of a pixel goes on around it, on its own side of the edges of the photograph.
#pragma once

#include <cstdint>

namespace linprim {

// A cross reaches so many pixels in each direction, twice as far as a window of PatchMatch holds a surface beyond its
// edge, and ends where grey values differ from the pixel's by this much, as a window's do.
constexpr int kCrossReach = 10, kCrossGrey = 25;

// For every pixel the share of the pixels around that belong to it and go on with its surface: their inverse depth is
// what its plane has there, or its own is what theirs has here, up to the share `tolerance` of it. 0 for pixels without
// a plane. A cross of pixels alike belongs to it, up and down, and to the left and right of each of these. Source:
// Zhang, Lu, Lafruit 2009, cross-based local stereo matching.
//
// `plane` holds inverse depths, not positive where they are unknown, then their change per column, then per row, each
// (height, width); `share` has the same shape as one of them.
void support(const uint8_t* grey, const float* plane, int height, int width, float tolerance, float* share);

}  // namespace linprim
