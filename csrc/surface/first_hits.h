// Which face of a mesh each pixel of a camera sees first.
#pragma once

#include <cstdint>

#include "surface/photo_view.h"

namespace linprim {

// The rays through the pixel centres of a view against all faces, by homogeneous edge functions (Olano and Greer 1997),
// so that faces need no clipping; a ray through an edge hits both faces. `corner` (faces, 3) are rows of `vertex`
// (vertices, 3), which are finite; faces are fewer than 2^31. Writes the depth (height, width) along the optical axis,
// infinite where nothing is hit, and the face (height, width), there -1; of equally near ones the first. Faces seen
// exactly from the side are not hit. Memory: 40 bytes per vertex, 8 per pixel. The same for any number of threads.
void first_hits(const PhotoView& view, int64_t vertices, const double* vertex, int64_t faces, const int64_t* corner,
                float* depth, int32_t* face);

}  // namespace linprim
