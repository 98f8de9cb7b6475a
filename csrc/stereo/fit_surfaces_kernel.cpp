// Fits surfaces around the pixels of one row; compiled once per instruction set.
#ifndef LINPRIM_ISA
#error "compile this file with -DLINPRIM_ISA=<name> -DLINPRIM_ISA_<NAME>=1"
#endif

#include <algorithm>
#include <cmath>
#include <cstring>
#include <numeric>

#include "stereo/fit_surfaces.h"
#include "stereo/wide.h"

namespace linprim {
namespace LINPRIM_ISA {
namespace {

// Width of the square around a pixel; terms of a surface; rows of a cross between two checks of `count_on`.
constexpr int kAcross = 2 * kCrossReach + 1, kTerms = 6, kRowsAtOnce = 2;
static_assert(kWide <= kRoomAfter);
// Powers of x and y in the terms of a second-order surface.
constexpr int kX[kTerms] = {0, 1, 0, 2, 1, 0}, kY[kTerms] = {0, 0, 1, 0, 1, 2};
// A term is dropped if elimination of the earlier terms leaves less than this share of its sum of squares: with only
// two columns, x * x is linear in x.
constexpr double kLeft = 1e-6;

// Inverse depth around a pixel: coefficients of the terms in columns x and rows y from the pixel.
struct Surface {
  float c[kTerms];
};

// Numbers of pixels that lie on a plane within the tolerance, and within 1/2, 1/4 and 1/8 of it.
struct Counts {
  int on[kScales] = {};
  int sum() const { return std::accumulate(on, on + kScales, 0); }
};

// Returns the number of each lane.
F lanes() {
  F numbers;
  for (int l = 0; l < kWide; ++l) numbers[l] = float(l);
  return numbers;
}

F absolute(F values) { return values < F{} ? -values : values; }

// Sums over the lanes.
int total(I values) {
  int sum = 0;
  for (int l = 0; l < kWide; ++l) sum += values[l];
  return sum;
}

// The cross of the pixel `at` in an image of inverse depths, behind which kRoomAfter more floats may be read.
struct PixelCross {
  const Crosses& crosses;
  const float* inverse;
  int64_t at;

  // Returns the number of pixels of the cross.
  int pixels() const {
    int all = 0;
    crosses.for_each_row(at, [&](int, int64_t, int left, int right) { all += left + right + 1; });
    return all;
  }

  // Counts the pixels of the cross, `all` in number, that lie on a plane within the tolerance and within 1/2, 1/4 and
  // 1/8 of it. Stops early once the sum of the four counts cannot exceed `most` any more.
  Counts count_on(const Surface& plane, float tolerance, int all, int most) const {
    I on[kScales] = {};
    int uncounted = all;
    bool enough = true;
    crosses.for_each_row(at, [&](int y, int64_t middle, int left, int right) {
      if (!enough) return;
      const F base = splat(plane.c[0] + plane.c[2] * float(y)), slope = splat(plane.c[1]), width = splat(tolerance);
      for (int x = -left; x <= right; x += kWide) {
        F there;
        std::memcpy(&there, inverse + middle + x, sizeof there);
        const F column = splat(float(x)) + lanes();
        const F expected = base + slope * column, off = absolute(there - expected), most_off = width * expected;
        const I inside = column <= splat(float(right));
        for (int k = 0; k < kScales; ++k) on[k] -= inside & (off < most_off * splat(1.0f / float(1 << k)));
      }
      uncounted -= left + right + 1;
      // Checks only every kRowsAtOnce rows, as a check costs as much as a row.
      if (y % kRowsAtOnce == 0) enough = total(on[0] + on[1] + on[2] + on[3]) + kScales * uncounted > most;
    });
    Counts counts;
    for (int k = 0; k < kScales; ++k) counts.on[k] = total(on[k]);
    return counts;
  }

  // Returns the mean of another image over the pixels of the cross that lie on a plane.
  float mean_on(const Surface& plane, float tolerance, const float* image) const {
    double sum = 0;
    int count = 0;
    crosses.for_each_row(at, [&](int y, int64_t middle, int left, int right) {
      for (int x = -left; x <= right; ++x) {
        const float there = plane.c[0] + plane.c[2] * float(y) + plane.c[1] * float(x);
        if (std::abs(inverse[middle + x] - there) < tolerance * there) sum += image[middle + x], ++count;
      }
    });
    return float(sum / std::max(count, 1));
  }
};

// Sums over the pixels that lie on a surface, per column of the square around a pixel: of powers of y (`ones`), and of
// residuals of inverse depth times powers of y (`differences`).
struct Columns {
  float ones[5][kAcross + kWide] = {}, differences[3][kAcross + kWide] = {};
};

// Computes these sums for the square around the pixel `at`.
Columns sums(const float* inverse, int height, int width, int64_t at, const Surface& surface, float tolerance) {
  Columns columns;
  const float* c = surface.c;
  const int row = int(at / width), column = int(at % width);
  const int left = std::min(kCrossReach, column), right = std::min(kCrossReach, width - 1 - column);
  const int up = std::min(kCrossReach, row), down = std::min(kCrossReach, height - 1 - row);
  for (int dx = -left; dx <= right; dx += kWide) {
    const F x = splat(float(dx)) + lanes(), bent = splat(c[3]) * x * x;
    const I inside = x <= splat(float(right));
    F ones[5] = {}, differences[3] = {};
    for (int dy = -up; dy <= down; ++dy) {
      const float y = float(dy);
      F there;
      std::memcpy(&there, inverse + at + int64_t(dy) * width + dx, sizeof there);
      const F expected = splat(c[0] + c[2] * y + c[5] * y * y) + splat(c[1] + c[4] * y) * x + bent;
      const F difference = there - expected, most_off = splat(tolerance) * expected;
      const I on = inside & (absolute(difference) < most_off);
      const F one = on ? splat(1.0f) : F{}, off = on ? difference : F{};
      const float power[5] = {1, y, y * y, y * y * y, y * y * y * y};
      for (int b = 0; b < 5; ++b) ones[b] += one * splat(power[b]);
      for (int b = 0; b < 3; ++b) differences[b] += off * splat(power[b]);
    }
    for (int b = 0; b < 5; ++b) std::memcpy(columns.ones[b] + dx + kCrossReach, &ones[b], sizeof ones[b]);
    for (int b = 0; b < 3; ++b)
      std::memcpy(columns.differences[b] + dx + kCrossReach, &differences[b], sizeof differences[b]);
  }
  return columns;
}

// Solves the normal equations by elimination. Their upper triangle is s[i][j] with j >= i, their right side
// s[i][kTerms]; dropped terms get 0.
void solve(double s[kTerms][kTerms + 1], double* solution) {
  constexpr int n = kTerms;
  double least[n];
  for (int i = 0; i < n; ++i) least[i] = kLeft * s[i][i];
  for (int i = 0; i < n; ++i) {
    for (int k = 0; k < i; ++k) {
      if (!(s[k][k] > 0)) continue;
      const double factor = s[k][i] / s[k][k];
      for (int j = i; j <= n; ++j) s[i][j] -= factor * s[k][j];
    }
    if (!(s[i][i] > least[i])) s[i][i] = 0;
  }
  for (int i = n - 1; i >= 0; --i) {
    solution[i] = 0;
    if (!(s[i][i] > 0)) continue;
    double rest = s[i][n];
    for (int j = i + 1; j < n; ++j) rest -= s[i][j] * solution[j];
    solution[i] = rest / s[i][i];
  }
}

// Fits a surface by least squares to the pixels that lie on it. Returns false if these are too few.
bool improve(const Columns& columns, Surface& surface) {
  double ones[5][5] = {}, differences[3][3] = {};  // by powers of x, then y
  for (int k = 0; k < kAcross; ++k) {
    double power = 1;
    for (int a = 0; a < 5; ++a, power *= k - kCrossReach) {
      for (int b = 0; a + b < 5; ++b) ones[a][b] += power * columns.ones[b][k];
      for (int b = 0; a + b < 3; ++b) differences[a][b] += power * columns.differences[b][k];
    }
  }
  if (ones[0][0] < kFewestFitted) return false;
  double s[kTerms][kTerms + 1], change[kTerms];
  for (int i = 0; i < kTerms; ++i) {
    for (int j = i; j < kTerms; ++j) s[i][j] = ones[kX[i] + kX[j]][kY[i] + kY[j]];
    s[i][kTerms] = differences[kX[i]][kY[i]];
  }
  solve(s, change);
  for (int i = 0; i < kTerms; ++i) surface.c[i] += float(change[i]);
  return true;
}

// Selects the plane of a pixel and fits its surface, as described at `fit_surfaces`.
void fit_pixel(const SurfaceFit& fit, int64_t at) {
  const float tolerance = fit.tolerance;
  const int64_t pixels = int64_t(fit.height) * fit.width;
  const float *plane = fit.inverse, *right_slope = fit.right_slope, *down_slope = fit.down_slope;
  const PixelCross cross{fit.crosses, plane, at};
  const int all = cross.pixels(), half = all / 2;
  Surface start{{plane[at], right_slope[at], down_slope[at], 0, 0, 0}};
  Counts best = cross.count_on(start, tolerance, all, 0);
  bool found = best.on[0] > half, own = true;
  int most = found ? best.sum() : 0;
  fit.crosses.for_each_row(at, [&](int y, int64_t middle, int left, int right) {
    if (y % kCandidateStep) return;
    for (int x = -(left - left % kCandidateStep); x <= right; x += kCandidateStep) {
      const int64_t other = middle + x;
      const float to_right = right_slope[other], to_bottom = down_slope[other];
      const Surface tried{{plane[other] - to_right * float(x) - to_bottom * float(y), to_right, to_bottom}};
      if (!(plane[other] > 0 && tried.c[0] > 0)) continue;
      const Counts counts = cross.count_on(tried, tolerance, all, most);
      if (counts.on[0] <= half || counts.sum() <= most) continue;
      found = true, start = tried, best = counts, most = counts.sum();
      own = std::abs(plane[at] - start.c[0]) < tolerance * start.c[0];
    }
  });
  fit.fitted_cost[at] = own ? fit.cost[at] : cross.mean_on(start, tolerance, fit.cost);
  Surface surface = start;
  if (found) {
    float narrow = tolerance;
    for (int k = 1; k < kScales && best.on[k] > half; ++k) narrow *= 0.5f;
    bool enough = true;
    for (int round = 0; enough && round < kFitRounds; ++round)
      enough = improve(sums(plane, fit.height, fit.width, at, surface, narrow), surface);
    if (!enough || !(std::abs(surface.c[0] - start.c[0]) < tolerance * start.c[0])) surface = start;
  }
  for (int k = 0; k < 3; ++k) fit.fitted[at + k * pixels] = surface.c[k];
}

void row_of(const SurfaceFit& fit, int row) {
  for (int64_t at = int64_t(row) * fit.width; at < int64_t(row + 1) * fit.width; ++at) fit_pixel(fit, at);
}

}  // namespace
}  // namespace LINPRIM_ISA

#define LINPRIM_JOIN2(a, b) a##b
#define LINPRIM_JOIN(a, b) LINPRIM_JOIN2(a, b)
SurfaceFitKernel LINPRIM_JOIN(surface_fit_kernel_, LINPRIM_ISA)() { return LINPRIM_ISA::row_of; }

}  // namespace linprim
