// Depths of pixels by what lies around them, within the edges of the photograph.
#pragma once

#include <cstdint>

namespace linprim {

// Of a pixel's cross (stereo/cross.h) only the planes in every kCandidateStep-th row and column, counted from the
// pixel, are tried.
constexpr int kCandidateStep = 5;
// Surfaces are fitted to so many pixels at least, twice as many as the most terms that they have, in so many rounds.
constexpr int kFewestFitted = 12, kFitRounds = 2;

// Fits a surface of inverse depth to the cross of every pixel, and takes its tangent plane at the pixel.
//
// A pixel starts from its own plane if more than half of its cross lies on that, up to the share `tolerance` of the
// inverse depth; else from the plane that is tried on which the most of it lies, and more than half. Without such a
// plane the pixel keeps its own. Then a surface of second order is fitted to what lies on it, in rounds. The pixel
// keeps the plane that it starts from if there are too few to fit, or if the surface would move it by more than
// `tolerance`.
//
// `plane` holds inverse depths, not positive where they are unknown, then their change per column, then per row, each
// (height, width), as does `fitted`. In `fitted_cost` pixels that start from another's plane have the mean `cost` of
// those on that plane, others their own. `tolerance` is between 0 and 1.
void fit_surfaces(const uint8_t* grey, const float* plane, const float* cost, int height, int width, float tolerance,
                  float* fitted, float* fitted_cost);

}  // namespace linprim
