#include "surface/visible_points.h"

#include <algorithm>

#include "base/parallel.h"

namespace linprim {
namespace {

constexpr int64_t kPointsPerItem = 4096;

}  // namespace

VisiblePoints visible_points(const PhotoView& view, const double* point, int64_t count, uint8_t* inside) {
  const int64_t items = (count + kPointsPerItem - 1) / kPointsPerItem;
  std::vector<ImagePlace> found(count);  // those of an item are stored from its first point on
  std::vector<int64_t> first(items + 1, 0);
  parallel_for(items, [&](int64_t item, int) {
    const int64_t begin = item * kPointsPerItem, end = std::min(begin + kPointsPerItem, count);
    int64_t next = begin;
    for (int64_t p = begin; p < end; ++p) {
      const ImagePlace at = place_of(view, point + 3 * p);
      inside[p] = is_visible(view, at);
      if (inside[p]) found[next++] = at;
    }
    first[item + 1] = next - begin;
  });
  for (int64_t item = 0; item < items; ++item) first[item + 1] += first[item];
  VisiblePoints result{std::vector<double>(2 * first[items]), std::vector<double>(first[items])};
  parallel_for(items, [&](int64_t item, int) {
    const ImagePlace* from = found.data() + item * kPointsPerItem;
    for (int64_t k = first[item]; k < first[item + 1]; ++k, ++from) {
      result.place[2 * k] = from->column, result.place[2 * k + 1] = from->row, result.depth[k] = from->depth;
    }
  });
  return result;
}

}  // namespace linprim
