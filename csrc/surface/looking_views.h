// Counts the views that look at points, and those that have a depth there.
#pragma once

#include <cstdint>
#include <vector>

#include "surface/photo_view.h"

namespace linprim {

// Sets looking[count] to the number of views that look at each `point` (count, 3): it is in front of the camera and in
// the image, and the view's depth there, if it is a number, is not smaller than the point's by more than the share
// `margin`. Sets knowing[count] to the number of views whose depth there differs by no more than that. Depths may be
// NaN; the images of the views are not used. Float64. The result is the same for any number of threads.
void count_looking_views(const std::vector<PhotoView>& views, const double* point, int64_t count, double margin,
                         int32_t* looking, int32_t* knowing);

}  // namespace linprim
