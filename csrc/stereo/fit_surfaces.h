// Depths of pixels by what lies around them, within the edges of the photograph.
#pragma once

#include <cstdint>

#include "stereo/cross.h"

namespace linprim {

// Of a pixel's cross (stereo/cross.h) only the planes in every kCandidateStep-th row and column, counted from the
// pixel, are tried. They are judged by so many tolerances, each half of the one before.
constexpr int kCandidateStep = 5, kScales = 4;
// Surfaces are fitted to so many pixels at least, twice as many as the most terms that they have, in so many rounds.
constexpr int kFewestFitted = 12, kFitRounds = 2;

// Fits a surface of inverse depth around every pixel, and takes its tangent plane at the pixel.
//
// A pixel starts from its own plane or one that is tried: that on which the most of its cross lies, in the sum over the
// tolerances, of those on which more than half lies within `tolerance`, a share of the inverse depth. Without such a
// plane the pixel keeps its own. Then a surface of second order is fitted, in rounds, to what lies on it of the square
// around the pixel, as wide as crosses are, within the narrowest of the tolerances that more than half of the cross
// keeps. The pixel keeps the plane that it starts from if there are too few to fit, or if the surface would move it by
// more than `tolerance`.
//
// `plane` holds inverse depths, not positive where they are unknown, then their change per column, then per row, each
// (height, width), as does `fitted`. In `fitted_cost` pixels that start from a plane beyond `tolerance` from their own
// have the mean `cost` of those of their cross on that plane, others their own. `tolerance` is between 0 and 1.
void fit_surfaces(const uint8_t* grey, const float* plane, const float* cost, int height, int width, float tolerance,
                  float* fitted, float* fitted_cost);

constexpr int kRoomAfter = 16;  // floats that a kernel may read after an image: its widest vector

// What `fit_surfaces` is given, for the rows of the kernels in fit_surfaces_kernel.cpp.
struct SurfaceFit {
  const Crosses& crosses;
  int height, width;
  const float *inverse, *right_slope, *down_slope;  // kRoomAfter floats more of `inverse`
  const float* cost;
  float tolerance;
  float *fitted, *fitted_cost;
};

using SurfaceFitKernel = void (*)(const SurfaceFit& fit, int row);
SurfaceFitKernel surface_fit_kernel_scalar();
#if defined(__x86_64__) || defined(_M_X64)
SurfaceFitKernel surface_fit_kernel_v2();
SurfaceFitKernel surface_fit_kernel_v3();
SurfaceFitKernel surface_fit_kernel_v4();
#else
SurfaceFitKernel surface_fit_kernel_neon();
#endif

}  // namespace linprim
