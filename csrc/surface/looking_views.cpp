#include "surface/looking_views.h"

#include <cmath>

#include "base/parallel.h"
#include "surface/visible_points.h"

namespace linprim {

void count_looking_views(const std::vector<PhotoView>& views, const double* point, int64_t count, double margin,
                         int32_t* looking, int32_t* knowing) {
  for_rows(count, [&](int64_t p) {
    looking[p] = knowing[p] = 0;
    for (const PhotoView& view : views) {
      const ImagePlace at = place_of(view, point + 3 * p);
      if (!is_visible(view, at)) continue;
      const double ratio = view.depth[int64_t(at.row) * view.width + int64_t(at.column)] / at.depth;
      looking[p] += !(ratio < 1 - margin);
      knowing[p] += std::abs(ratio - 1) <= margin;
    }
  });
}

}  // namespace linprim
