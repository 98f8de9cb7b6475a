// Smooths stereo depths by fitting surfaces to the pixels around, within the edges of the photograph.
#pragma once

#include <cstdint>

#include "stereo/cross.h"

namespace linprim {

// Only the planes in every kCandidateStep-th row and column of a pixel's cross (stereo/cross.h), counted from the
// pixel, are candidates. They are rated with kScales tolerances, each half of the previous one.
constexpr int kCandidateStep = 5, kScales = 4;
// Surfaces are fitted to at least kFewestFitted pixels, twice as many as they have terms at most, in kFitRounds rounds.
constexpr int kFewestFitted = 12, kFitRounds = 2;

// Fits a surface of inverse depth around every pixel, and returns its tangent plane at the pixel.
//
// Candidates are the pixel's own plane and those of the cross. The candidate with the most pixels of the cross on it is
// selected, by the sum of the counts over the tolerances; more than half of the cross must lie within `tolerance`,
// relative to inverse depth. If there is no such candidate, the pixel keeps its own plane. Then a second-order surface
// is fitted, in rounds, to the pixels that lie on it in the square around the pixel, as wide as crosses are, within the
// narrowest of the tolerances that contains more than half of the cross. The pixel gets the selected plane unchanged if
// there are too few pixels to fit, or if the surface would move it by more than `tolerance`.
//
// `plane` holds inverse depths, not positive where unknown, then their slopes per column, then per row, each (height,
// width); so does `fitted`. In `fitted_cost`, pixels whose selected plane differs from their own by more than
// `tolerance` have the mean `cost` of the pixels of their cross on that plane, others their own cost. `tolerance` is
// between 0 and 1.
void fit_surfaces(const uint8_t* grey, const float* plane, const float* cost, int height, int width, float tolerance,
                  float* fitted, float* fitted_cost);

constexpr int kRoomAfter = 16;  // floats that a kernel may read after an image: its widest vector

// Arguments of `fit_surfaces` for the row kernels in fit_surfaces_kernel.cpp.
struct SurfaceFit {
  const Crosses& crosses;
  int height, width;
  const float *inverse, *right_slope, *down_slope;  // padded by kRoomAfter floats after `inverse`
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
