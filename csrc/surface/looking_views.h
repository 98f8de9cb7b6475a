// How many photographs look at points, and how many of them know a depth there.
#pragma once

#include <cstdint>
#include <vector>

#include "surface/photo_view.h"

namespace linprim {

// Sets looking[count] to how many of the views look at each of `point` (count, 3): it is in front of the camera and in
// the image, and the view's depth there, if that is a number, is not less than its own by more than the share `margin`
// of that; and knowing[count] to how many have a depth there that differs by no more. Depths may be NaN; of the views
// images are not looked at. Float64. The same for any number of threads.
void count_looking_views(const std::vector<PhotoView>& views, const double* point, int64_t count, double margin,
                         int32_t* looking, int32_t* knowing);

}  // namespace linprim
