// How far the surface of a pixel goes on around it, on its own side of the edges of the photograph.
#pragma once

#include <cstdint>

namespace linprim {

// For every pixel the share of the pixels of its cross (stereo/cross.h) that go on with its surface: their inverse
// depth is what its plane has there, or its own is what theirs has here, up to the share `tolerance` of it. 0 for
// pixels without a plane.
//
// `plane` holds inverse depths, not positive where they are unknown, then their change per column, then per row, each
// (height, width); `share` has the same shape as one of them.
void support(const uint8_t* grey, const float* plane, int height, int width, float tolerance, float* share);

}  // namespace linprim
