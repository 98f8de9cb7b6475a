// Rasterizes a mesh: the first face on the ray through each pixel centre of a camera.
#pragma once

#include <cstdint>

#include "surface/photo_view.h"

namespace linprim {

// Intersects the rays through the pixel centres of a view with all faces by homogeneous edge functions (Olano and Greer
// 1997), so that faces need no clipping; a ray through an edge hits both faces. `corner` (faces, 3) are rows of
// `vertex` (vertices, 3), which are finite; faces are fewer than 2^31. Writes the depth (height, width) along the
// optical axis, infinite where nothing is hit, and the face (height, width), -1 there; of equally near faces the first.
// Faces seen exactly edge-on are not hit. Memory: 40 bytes per vertex, 8 per pixel. The result is the same for any
// number of threads.
void first_hits(const PhotoView& view, int64_t vertices, const double* vertex, int64_t faces, const int64_t* corner,
                float* depth, int32_t* face);

}  // namespace linprim
