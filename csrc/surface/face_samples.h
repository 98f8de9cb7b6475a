// Which points of the faces of a mesh a view may see, by a depth map.
#pragma once

#include <cstdint>

#include "surface/photo_view.h"

namespace linprim {

constexpr int kMostFaceSamples = 8;

struct Faces {
  int64_t count;
  const double* vertex;   // (V, 3)
  const int64_t* corner;  // (count, 3) rows of `vertex`
  const uint8_t* skip;    // (count) faces that are not asked for
};

// Sets bit s of `found` (count) where sample s of a face, the point with the barycentric coordinates bary[3 s] and on,
// lies in the image and no farther than the largest depth d of the four pixels whose centres are around it: than (1 +
// behind) d + slack. At most kMostFaceSamples samples. Only the pose, the lens and the depth are used.
void face_samples(const PhotoView& view, const Faces& faces, const double* bary, int samples, double behind,
                  double slack, uint8_t* found);

}  // namespace linprim
