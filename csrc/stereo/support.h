// Measures how far the surface of a pixel continues around it, within the edges of the photograph.
#pragma once

#include <cstdint>

namespace linprim {

// Computes, for every pixel, the share of the pixels of its cross (stereo/cross.h) that continue its surface: their
// inverse depth agrees with its plane there, or its own inverse depth with their plane here, up to the relative
// `tolerance`. 0 for pixels without a plane.
//
// `plane` holds inverse depths, not positive where unknown, then their slopes per column, then per row, each (height,
// width); `share` has the shape of one of these.
void support(const uint8_t* grey, const float* plane, int height, int width, float tolerance, float* share);

}  // namespace linprim
