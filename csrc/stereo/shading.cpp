#include "stereo/shading.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

namespace linprim {
namespace {

// Range of gains; rounds of reweighted least squares, in which residuals beyond two standard deviations lose weight.
constexpr double kLeastGain = 0.7, kMostGain = 1.4;
constexpr int kRounds = 3;
// Standard deviation of a normal distribution per median absolute deviation; constant added to a deviation, in grey
// levels.
constexpr double kPerMedian = 1.4826, kLeastDeviation = 0.05;
// Bounds against division by zero, in powers of grey levels: least sum of squares; constant added to the variance of
// residuals; least standard deviation of values.
constexpr double kFlat = 1e-6, kLeastVariance = 1e-4, kLeastSpread = 1e-3;

double dot(const std::vector<double>& a, const std::vector<double>& b) {
  double sum = 0;
  for (size_t k = 0; k < a.size(); ++k) sum += a[k] * b[k];
  return sum;
}

double mean(const std::vector<double>& a) {
  double sum = 0;
  for (double x : a) sum += x;
  return sum / double(a.size());
}

double variance(const std::vector<double>& a) {
  const double middle = mean(a);
  double sum = 0;
  for (double x : a) sum += (x - middle) * (x - middle);
  return sum / double(a.size());
}

// The boxes that both photographs show, one entry per box.
struct Boxes {
  std::vector<int64_t> index;              // row in the ShadedPair
  std::vector<double> ours, theirs;        // mean grey values
  std::vector<double> slope;               // derivative of theirs by inverse depth, for a gain of 1
  std::vector<double> gain, left, weight;  // by match(): derivative of ours by theirs, residual, Huber weight
};

// Projects the boxes along the plane into the other photograph. Keeps those that lie inside of it and have no edge
// there.
Boxes boxes_of_both(const ShadedPair& pair) {
  Boxes found;
  for (int64_t k = 0; k < pair.boxes; ++k) {
    const double* ray = pair.rays + 3 * k;
    const double inverse = ray[0] * pair.plane[0] + ray[1] * pair.plane[1] + ray[2] * pair.plane[2];
    double point[3];
    for (int a = 0; a < 3; ++a) {
      const double* row = pair.turn + 3 * a;
      point[a] = ray[0] * row[0] + ray[1] * row[1] + ray[2] * row[2] + inverse * pair.shift[a];
    }
    if (!(inverse > 0 && point[2] > 0)) continue;
    const double right = point[0] / point[2], down = point[1] / point[2];
    const double x = right * pair.focal_x + pair.center_x - 0.5, y = down * pair.focal_y + pair.center_y - 0.5;
    if (!(x >= 0 && y >= 0 && x < pair.width - 1 && y < pair.height - 1)) continue;
    const int64_t near = int64_t(std::nearbyint(y)) * pair.width + int64_t(std::nearbyint(x));
    if (!pair.plain[near]) continue;
    const int64_t left = int64_t(x), top = int64_t(y);
    const double u = x - double(left), v = y - double(top);
    const float* upper = pair.means + 3 * (top * pair.width + left);
    const float* lower = upper + 3 * pair.width;
    double sampled[3];
    for (int a = 0; a < 3; ++a)
      sampled[a] = (upper[a] * (1 - u) + upper[a + 3] * u) * (1 - v) + (lower[a] * (1 - u) + lower[a + 3] * u) * v;
    const double by_x = (pair.shift[0] - right * pair.shift[2]) / point[2] * pair.focal_x;
    const double by_y = (pair.shift[1] - down * pair.shift[2]) / point[2] * pair.focal_y;
    found.index.push_back(k), found.ours.push_back(pair.value[k]), found.theirs.push_back(sampled[0]);
    found.slope.push_back(sampled[1] * by_x + sampled[2] * by_y);
  }
  return found;
}

// Fits ours as a function of theirs: an offset, a gain within its range, and a bend of the gain (a quadratic term),
// which a tone curve causes where exposures differ. Least squares with Huber's weights.
void match(Boxes& boxes) {
  const size_t count = boxes.index.size();
  std::vector<double> a(count), b(count), square(count), size(count);
  boxes.weight.assign(count, 1.0), boxes.left.assign(count, 0.0), boxes.gain.assign(count, 1.0);
  for (int round = 0; round < kRounds; ++round) {
    const std::vector<double>& w = boxes.weight;
    double total = 0;
    for (double x : w) total += x;
    const double middle_a = dot(w, boxes.ours) / total, middle_b = dot(w, boxes.theirs) / total;
    double ab = 0, bb = 0, bbb = 0;
    for (size_t k = 0; k < count; ++k) {
      a[k] = boxes.ours[k] - middle_a, b[k] = boxes.theirs[k] - middle_b;
      ab += w[k] * a[k] * b[k], bb += w[k] * b[k] * b[k], bbb += w[k] * b[k] * b[k] * b[k];
    }
    const double power = std::max(bb, kFlat), along = bbb / power;
    const double gain = std::clamp(ab / power, kLeastGain, kMostGain);
    double bent = 0, curved = 0;
    for (size_t k = 0; k < count; ++k) {
      square[k] = b[k] * b[k] - bb / total - along * b[k];
      bent += w[k] * square[k] * a[k], curved += w[k] * square[k] * square[k];
    }
    const double bend = bent / std::max(curved, kFlat);
    for (size_t k = 0; k < count; ++k) {
      boxes.left[k] = a[k] - gain * b[k] - bend * square[k];
      boxes.gain[k] = gain + bend * (2 * b[k] - along);
      size[k] = std::abs(boxes.left[k]);
    }
    const auto middle = size.begin() + int64_t(count / 2);
    std::nth_element(size.begin(), middle, size.end());
    const double deviation = kPerMedian * *middle + kLeastDeviation;
    for (size_t k = 0; k < count; ++k) boxes.weight[k] = 1 / std::max(1.0, std::abs(boxes.left[k]) / (2 * deviation));
  }
}

// Subtracts from `values` their projection onto `base`, which has unit length or is 0.
void take_out(std::vector<double>& values, const std::vector<double>& base) {
  const double along = dot(values, base);
  for (size_t k = 0; k < values.size(); ++k) values[k] -= along * base[k];
}

}  // namespace

ShadedComparison compare_shading(const ShadedPair& pair, uint8_t* shown, double* left) {
  ShadedComparison result{};
  std::fill_n(shown, pair.boxes, uint8_t(0)), std::fill_n(left, pair.boxes, 0.0);
  Boxes boxes = boxes_of_both(pair);
  const size_t count = boxes.index.size();
  if (count == 0 || int64_t(count) < pair.least) return result;
  match(boxes);
  for (size_t k = 0; k < count; ++k) shown[boxes.index[k]] = 1, left[boxes.index[k]] = boxes.left[k];

  result.boxes = int64_t(count);
  result.variance = variance(boxes.ours);
  for (size_t k = 0; k < count; ++k) result.left_variance += boxes.weight[k] * boxes.left[k] * boxes.left[k];
  result.left_variance = result.left_variance / double(count) + kLeastVariance;

  // Weighted derivatives of the fitted values by each parameter (`slope`), made orthogonal to the terms of offset, gain
  // and bend (`taken`), which are thereby eliminated.
  std::vector<double> root(count);
  for (size_t k = 0; k < count; ++k) root[k] = std::sqrt(boxes.weight[k]);
  const double middle = mean(boxes.theirs), spread = std::max(std::sqrt(variance(boxes.theirs)), kLeastSpread);
  std::array<std::vector<double>, 3> taken, slope;
  for (int a = 0; a < 3; ++a) {
    taken[a].resize(count), slope[a].resize(count);
    for (size_t k = 0; k < count; ++k) {
      const double value = (boxes.theirs[k] - middle) / spread;
      taken[a][k] = root[k] * (a == 0 ? 1.0 : a == 1 ? value : value * value);
      const double* ray = pair.rays + 3 * boxes.index[k];
      const double moved = ray[0] * pair.moves[a] + ray[1] * pair.moves[3 + a] + ray[2] * pair.moves[6 + a];
      slope[a][k] = boxes.slope[k] * boxes.gain[k] * root[k] * moved;
    }
  }
  for (int a = 0; a < 3; ++a) {
    const double before = std::sqrt(dot(taken[a], taken[a]));
    // Gram-Schmidt twice: after one pass, rounding leaves a part that is not orthogonal.
    for (int turn = 0; turn < 2; ++turn)
      for (int b = 0; b < a; ++b) take_out(taken[a], taken[b]);
    const double length = std::sqrt(dot(taken[a], taken[a]));
    const double scale = length > 1e-10 * before ? 1 / length : 0;  // 0 if it depends on earlier terms: equal values
    for (double& x : taken[a]) x *= scale;
  }
  for (std::vector<double>& one : slope)
    for (const std::vector<double>& base : taken) take_out(one, base);
  std::vector<double> weighted(count);
  for (size_t k = 0; k < count; ++k) weighted[k] = boxes.left[k] * root[k];
  for (int a = 0; a < 3; ++a) {
    for (int b = 0; b < 3; ++b) result.information[3 * a + b] = dot(slope[a], slope[b]) / result.left_variance;
    result.downhill[a] = dot(slope[a], weighted) / result.left_variance;
  }
  return result;
}

}  // namespace linprim
