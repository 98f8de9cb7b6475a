// Measures how well a plane maps the shading of a plain region into another photograph, and how to improve the plane.
#pragma once

#include <cstdint>

namespace linprim {

// A region of `boxes` boxes, with rays (boxes, 3) of depth 1 and mean grey values, and another photograph.
struct ShadedPair {
  int64_t boxes;
  const double *rays, *value;
  double plane[3];           // ray . plane = inverse depth
  double turn[9], shift[3];  // from the region's camera to the other one
  double focal_x, focal_y, center_x, center_y;
  int height, width;     // of the other photograph, in which
  const float* means;    // (height, width, 3) are means of boxes and their slopes per column and row,
  const uint8_t* plain;  // and (height, width) says where a box has no edge
  double moves[9];       // (3, 3), change of the plane by each of three parameters
  int64_t least;         // smallest number of boxes visible in both
};

// Result of compare_shading: the number of boxes visible in both photographs, 0 if fewer than `least`; the weighted
// variance of the residuals, and the variance of the values themselves; Gauss-Newton matrix and right side for the
// parameters.
struct ShadedComparison {
  int64_t boxes;
  double left_variance, variance;
  double information[9], downhill[3];
};

// Writes for each box whether the other photograph shows it without an edge (`shown`), and the residual of its value
// after fitting an offset, a gain and the gain's bend (`left`, 0 where it is not shown).
ShadedComparison compare_shading(const ShadedPair& pair, uint8_t* shown, double* left);

}  // namespace linprim
