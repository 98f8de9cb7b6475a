// Converts a depth map into surfels, small planes per pixel, for `add_votes`.
#pragma once

#include "surface/fuse.h"

namespace linprim {

// A depth map of a camera whose rays through pixel centres are (x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy, 1. Arrays are
// (height, width).
struct DepthMap {
  double pose[12];  // world to camera, rows of rotation and translation
  double fx, fy, cx, cy;
  int width, height;
  const double* depth;        // along the optical axis; no surface where it is not positive and finite
  const uint8_t* background;  // pixels without surface whose ray is free
  const uint8_t* clamped;     // depths that are lower bounds: the ray is free up to there
  const double* confidence;   // not negative, multiplies weights
};

struct SurfelRules {
  double voxel, truncation;  // lengths
  double slope_ratio;        // slopes to both sides are averaged if they differ by no more than this, else the flatter
                             // one is taken
  double least_cosine;       // planes that are tilted further are replaced by one that faces the ray
};

// Fills `surfels` (height, width). A plane a X + b Y + c Z = 1 in camera space has the inverse depth a x + b y + c
// along the ray (x, y, 1). So a and b are the slopes of the inverse depth times the focal lengths, and the signed
// distance of a point is (1 - a X - b Y - c Z) / |(a, b, c)|. The result is the same for any number of threads.
void make_surfels(const DepthMap& map, const SurfelRules& rules, Surfel* surfels);

}  // namespace linprim
