// Tests by a depth map which sample points of a mesh's faces a view may see.
#pragma once

#include <cstdint>

#include "surface/photo_view.h"

namespace linprim {

constexpr int kMostFaceSamples = 8;

struct Faces {
  int64_t count;
  const double* vertex;   // (V, 3)
  const int64_t* corner;  // (count, 3) rows of `vertex`
  const uint8_t* skip;    // (count) faces that are not tested
};

// Sets bit s of `found` (count) if sample s of a face, at the barycentric coordinates bary[3 s] to bary[3 s + 2], lies
// in the image and is not farther away than (1 + behind) d + slack, with d the largest depth of the four pixels whose
// centres are around it. At most kMostFaceSamples samples. Only the pose, the lens and the depth of the view are used.
void face_samples(const PhotoView& view, const Faces& faces, const double* bary, int samples, double behind,
                  double slack, uint8_t* found);

}  // namespace linprim
