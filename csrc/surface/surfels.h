// A depth map as small planes, one per pixel, that `add_votes` takes.
#pragma once

#include "surface/fuse.h"

namespace linprim {

// Of a camera whose rays through the middles of pixels are (x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy, 1. Arrays are
// (height, width).
struct DepthMap {
  double pose[12];  // world to camera, rows of rotation and translation
  double fx, fy, cx, cy;
  int width, height;
  const double* depth;        // along the optical axis; no surface where it is not positive and finite
  const uint8_t* background;  // without a surface: the ray is free
  const uint8_t* clamped;     // a least depth: the ray is free up to there
  const double* confidence;   // not negative, multiplies weights
};

struct SurfelRules {
  double voxel, truncation;  // lengths
  double slope_ratio;        // slopes to both sides are averaged if they differ by no more than this, else the flatter
                             // one is taken
  double least_cosine;       // planes that are tilted further face their ray
};

// Fills `surfels` (height, width). A plane a X + b Y + c Z = 1 in the camera's space has the inverse depth
// a x + b y + c along the ray (x, y, 1), so a and b are the slopes of the inverse depth times the focal lengths, and
// the signed distance of a point is (1 - a X - b Y - c Z) / |(a, b, c)|. The same whatever the number of threads.
void make_surfels(const DepthMap& map, const SurfelRules& rules, Surfel* surfels);

}  // namespace linprim
