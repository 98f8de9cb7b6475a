// PatchMatch for the pixels of one row, one pixel per SIMD lane; compiled once per instruction set.
#ifndef LINPRIM_ISA
#error "compile this file with -DLINPRIM_ISA=<name> -DLINPRIM_ISA_<NAME>=1"
#endif

#include <algorithm>
#include <cmath>
#include <cstring>
#include "stereo/patch_match.h"
#include "stereo/wide.h"

namespace linprim {
namespace LINPRIM_ISA {
namespace {

constexpr int kSamples = kWindowSide * kWindowSide;
// Bilateral weights of a window: standard deviations in pixels (kNearPixels) and in grey values (kNearGrey). Samples
// whose grey value differs by more than kFarGrey deviations have no weight. The next larger deviation in grey is used
// where the samples have no more than kOwnShare of the spatial weights of the window, or too little texture.
constexpr float kNearPixels = 5, kFarGrey = 2.5f, kOwnShare = 0.5f;
constexpr int kGreys = 3;
constexpr float kNearGrey[kGreys] = {10, 25, 60};
// A window has texture if its variance is above this multiple of the noise variance: a correct match then costs 0.2 at
// most.
constexpr float kInformed = 4;
// View selection (ACMH): a cost below kGood exp(-iteration^2 / kGoodFalls) is a good match, one above kBad a bad match.
// kCostSpread: standard deviation of the weight of good costs.
constexpr float kGood = 0.8f, kGoodFalls = 90, kBad = 1.2f, kCostSpread = 0.3f;
// Regions that give candidates for propagation; planes that are tried in refinement.
constexpr int kRegions = 8, kRefinements = 5;
// Largest perturbations: of the inverse depth, relative to itself or to 5 % of its upper limit, whichever is larger,
// and divided by iteration + 1; of each component of the unit normal.
constexpr float kDepthStep = 0.02f, kNormalStep = 0.06f;
// Geometric consistency: cost per pixel of forward-backward reprojection error, and the error in pixels at which it is
// clamped.
constexpr float kGeometryWeight = 0.1f, kGeometryMost = 4;
constexpr float kWorst = 2;  // largest photometric cost, also of planes outside of a view
// Least cosine between a plane's normal and the ray.
constexpr float kFlattest = 0.12f;

// Hash of an integer. Random numbers are seeded by pixel and iteration.
inline uint32_t mixed(uint32_t a) {
  a ^= a >> 16, a *= 0x7feb352du, a ^= a >> 15, a *= 0x846ca68bu, a ^= a >> 16;
  return a;
}
struct Random {
  uint32_t state;
  float next() {  // -1 to 1
    state = mixed(state + 0x9e3779b9u);
    return float(int32_t(state)) * (1 / 2147483648.f);
  }
};

// Plane hypotheses, one per lane: inverse depth and its slopes per column and per row.
struct Planes {
  F w, x, y;
};

// A packet: pixels that are processed together, one per lane, with their reference windows and view weights.
struct Packet {
  F column, row;
  F weight[kSamples], centered[kSamples];  // reference window: weights with sum 1; weights times (grey - mean)
  F deviation;                             // standard deviation of the window, noise included
  F view[kMostSources];                    // weights of the views
  int count;                               // lanes in use; the others repeat the last of these
  int at[kWide];                           // index of the pixel
};

// Returns the photometric cost of planes in a view: 1 - normalised cross correlation (NCC) of the reference window and
// the window that the plane maps it to, clamped to 0 to kWorst. Windows are small, so the plane's homography is
// replaced by its derivative at the centre.
inline F photo_cost(const PatchMatch& M, const StereoSource& S, const Packet& P, const Planes& plane) {
  F p[3], dx[3], dy[3];
  for (int k = 0; k < 3; ++k) {
    p[k] = S.to[3 * k] * P.column + S.to[3 * k + 1] * P.row + S.to[3 * k + 2] + S.shift[k] * plane.w;
    dx[k] = S.to[3 * k] + S.shift[k] * plane.x, dy[k] = S.to[3 * k + 1] + S.shift[k] * plane.y;
  }
  const F most_u = splat(float(S.width) - 1.001f), most_v = splat(float(S.height) - 1.001f), inverse = 1.0f / p[2];
  // Lanes whose centre is outside of the photograph or behind its camera.
  const F u0 = p[0] * inverse, v0 = p[1] * inverse;
  const I bad = (p[2] <= 1e-6f) | (u0 < 0.0f) | (v0 < 0.0f) | (u0 > most_u) | (v0 > most_v);
  bool none = true;
  for (int l = 0; l < kWide; ++l) none &= bad[l] != 0;
  if (none) return splat(kWorst);
  const F u_x = (dx[0] - u0 * dx[2]) * inverse, u_y = (dy[0] - u0 * dy[2]) * inverse;
  const F v_x = (dx[1] - v0 * dx[2]) * inverse, v_y = (dy[1] - v0 * dy[2]) * inverse;
  F sum{}, square{}, product{};
  constexpr float kFirst = -0.5f * kWindowStep * (kWindowSide - 1);
  int k = 0;
  for (int i = 0; i < kWindowSide; ++i) {
    const float down = kFirst + kWindowStep * i;
    const F u_row = u0 + down * u_y, v_row = v0 + down * v_y;
    for (int j = 0; j < kWindowSide; ++j, ++k) {
      const float right = kFirst + kWindowStep * j;
      const F u = vmin(vmax(u_row + right * u_x, F{}), most_u), v = vmin(vmax(v_row + right * v_x, F{}), most_v);
      const I column = __builtin_convertvector(u, I), row = __builtin_convertvector(v, I);
      const F a = u - __builtin_convertvector(column, F), b = v - __builtin_convertvector(row, F);
      const I quad = gather(S.quads, row * S.width + column);
      const F g00 = __builtin_convertvector(quad & 255, F), g10 = __builtin_convertvector((quad >> 8) & 255, F);
      const F g01 = __builtin_convertvector((quad >> 16) & 255, F),
              g11 = __builtin_convertvector((quad >> 24) & 255, F);
      const F top = g00 + a * (g10 - g00), bottom = g01 + a * (g11 - g01), grey = top + b * (bottom - top);
      const F weighted = P.weight[k] * grey;
      sum += weighted, square += weighted * grey, product += P.centered[k] * grey;
    }
  }
  const F variance = vmax(square - sum * sum, F{}) + M.noise;
  const F cost = 1.0f - product / (P.deviation * vsqrt(variance));
  return bad ? splat(kWorst) : vmin(vmax(cost, F{}), splat(kWorst));
}

// Returns the geometric cost of planes in a view: the forward-backward reprojection error in pixels, weighted and
// clamped. Forward, the pixel is mapped along its plane into the view; back, along the depth that the view has there.
// Without such a depth the cost is the largest.
inline F geometry_cost(const StereoSource& S, const Packet& P, const Planes& plane) {
  F p[3], q[3];
  for (int k = 0; k < 3; ++k)
    p[k] = S.to[3 * k] * P.column + S.to[3 * k + 1] * P.row + S.to[3 * k + 2] + S.shift[k] * plane.w;
  const F u = p[0] / p[2], v = p[1] / p[2];
  const I inside =
      (p[2] > 1e-6f) & (u > -0.5f) & (v > -0.5f) & (u < float(S.width) - 0.5f) & (v < float(S.height) - 0.5f);
  F w;
  for (int l = 0; l < kWide; ++l) {
    w[l] = inside[l] ? S.inverse_depth[int(v[l] + 0.5f) * S.width + int(u[l] + 0.5f)] : -1.0f;
  }
  for (int k = 0; k < 3; ++k)
    q[k] = S.back[3 * k] * u + S.back[3 * k + 1] * v + S.back[3 * k + 2] + S.back_shift[k] * w;
  const F a = q[0] / q[2] - P.column, b = q[1] / q[2] - P.row;
  const F error = vmin(vsqrt(a * a + b * b), splat(kGeometryMost));
  return kGeometryWeight * ((w >= 0.0f) & (q[2] > 1e-6f) ? error : splat(kGeometryMost));
}

// Returns the matching cost of planes in a view: photometric, plus geometric if the view has depths.
inline F view_cost(const PatchMatch& M, const StereoSource& S, const Packet& P, const Planes& plane) {
  const F cost = photo_cost(M, S, P, plane);
  return S.inverse_depth ? cost + geometry_cost(S, P, plane) : cost;
}

// Returns the mean of the views' costs, weighted by P.view.
inline F joint_cost(const PatchMatch& M, const Packet& P, const F* cost) {
  F sum{}, total{};
  for (int v = 0; v < M.sources; ++v) sum += P.view[v] * cost[v], total += P.view[v];
  return sum / vmax(total, splat(1e-12f));
}

// Computes the unit normal of a plane. It points away from the camera (n . ray > 0 for w > 0); (0, 0, 1) for the plane
// at infinity.
inline void normal_of(const PatchMatch& M, float column, float row, float w, float x, float y, float normal[3]) {
  // n is parallel to (w_x f_x, w_y f_y, w - w_x (column - c_x) - w_y (row - c_y)): n . X = 1 for w = n . ray.
  const float n[3] = {x * M.focal_x, y * M.focal_y, w - x * (column - M.center_x) - y * (row - M.center_y)};
  const float length = std::sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
  for (int k = 0; k < 3; ++k) normal[k] = length > 0 ? n[k] / length : float(k == 2);
}

// Computes the plane at a pixel with inverse depth w and this normal. A normal with a cosine to the ray below kFlattest
// is turned until it has that cosine.
inline void plane_of(const PatchMatch& M, float column, float row, float w, const float normal[3], float plane[3]) {
  const float ray[3] = {(column - M.center_x) / M.focal_x, (row - M.center_y) / M.focal_y, 1};
  const float length = std::sqrt(ray[0] * ray[0] + ray[1] * ray[1] + 1);
  float n[3] = {normal[0], normal[1], normal[2]};
  float facing = (n[0] * ray[0] + n[1] * ray[1] + n[2]) / length;
  if (facing < kFlattest) {  // n = tangential + facing ray: keep the tangential part
    float tangential[3], size = 0;
    for (int k = 0; k < 3; ++k) tangential[k] = n[k] - facing * ray[k] / length, size += tangential[k] * tangential[k];
    size = std::sqrt(size);
    const float keep = size > 0 ? std::sqrt(1 - kFlattest * kFlattest) / size : 0;
    for (int k = 0; k < 3; ++k) n[k] = keep * tangential[k] + kFlattest * ray[k] / length;
    facing = kFlattest;
  }
  const float scale = w / (facing * length);
  plane[0] = w, plane[1] = scale * n[0] / M.focal_x, plane[2] = scale * n[1] / M.focal_y;
}

// Draws a unit vector uniformly by rejection sampling.
inline void random_normal(Random& random, float n[3]) {
  float square;
  do {
    for (int k = 0; k < 3; ++k) n[k] = random.next();
    square = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
  } while (square > 1 || square < 1e-3f);
  const float length = std::sqrt(square);
  for (int k = 0; k < 3; ++k) n[k] /= length;
}

// Stores the plane of a lane.
inline void put(Planes& planes, int lane, const float plane[3]) {
  planes.w[lane] = plane[0], planes.x[lane] = plane[1], planes.y[lane] = plane[2];
}

// Returns the variance of the grey values of the 3x3 pixels around a pixel.
inline float local_variance(const PatchMatch& M, int column, int row) {
  float sum = 0, square = 0, n = 0;
  for (int y = std::max(row - 1, 0); y <= std::min(row + 1, M.height - 1); ++y)
    for (int x = std::max(column - 1, 0); x <= std::min(column + 1, M.width - 1); ++x) {
      const float g = M.grey[y * M.width + x];
      sum += g, square += g * g, ++n;
    }
  return square / n - sum / n * (sum / n);
}

// Tables for the samples of a window: their offsets from the centre, which are odd numbers of pixels; their spatial
// weights `near` and the sum of these; and weights `falls` by absolute difference of grey values, for each deviation in
// kNearGrey.
struct WindowTables {
  int down[kSamples], right[kSamples];
  float near[kSamples], all_near = 0, falls[kGreys][256];
  WindowTables() {
    static_assert(kWindowStep * (kWindowSide - 1) % 2 == 0);
    constexpr int kFirst = -kWindowStep * (kWindowSide - 1) / 2;
    for (int k = 0; k < kSamples; ++k) {
      const int y = kFirst + kWindowStep * (k / kWindowSide), x = kFirst + kWindowStep * (k % kWindowSide);
      down[k] = y, right[k] = x;
      near[k] = std::exp(-0.5f * float(y * y + x * x) / (kNearPixels * kNearPixels)), all_near += near[k];
    }
    for (int s = 0; s < kGreys; ++s)
      for (int g = 0; g < 256; ++g) {
        const float away = float(g) / kNearGrey[s];
        falls[s][g] = away > kFarGrey ? 0 : std::exp(-0.5f * away * away);
      }
  }
};

// Computes the weights of the reference windows. Samples similar in grey to the pixel are preferred. A larger deviation
// in grey is used if these samples do not suffice and the 3x3 pixels around the pixel have texture, so that an edge
// runs through the pixel itself. A plain pixel beside an edge keeps the smallest deviation with which any sample has
// weight, because it may belong to the surface behind the edge.
inline void look(const PatchMatch& M, Packet& P) {
  static const WindowTables tables;
  for (int l = 0; l < kWide; ++l) {
    const int column = int(P.column[l]), row = int(P.row[l]);
    const int middle = M.grey[row * M.width + column];
    int grey[kSamples];
    for (int k = 0; k < kSamples; ++k) {
      const int y = std::clamp(row + tables.down[k], 0, M.height - 1);
      const int x = std::clamp(column + tables.right[k], 0, M.width - 1);
      grey[k] = M.grey[y * M.width + x];
    }
    const float informed = kInformed * M.noise;
    const bool plain = local_variance(M, column, row) < informed;
    float weight[kSamples], total, mean, variance;
    for (int s = 0; s < kGreys; ++s) {
      total = mean = variance = 0;
      for (int k = 0; k < kSamples; ++k) {
        weight[k] = tables.falls[s][std::abs(grey[k] - middle)] * tables.near[k];
        total += weight[k], mean += weight[k] * float(grey[k]);
      }
      if (!(total > 0)) continue;  // no sample is similar to the pixel
      mean /= total;
      for (int k = 0; k < kSamples; ++k) {
        const float difference = float(grey[k]) - mean;
        variance += weight[k] * difference * difference;
      }
      variance /= total;
      if (plain || (variance > informed && total > kOwnShare * tables.all_near)) break;
    }
    for (int k = 0; k < kSamples; ++k) {
      const float w = total > 0 ? weight[k] / total : 0;
      P.weight[k][l] = w, P.centered[k][l] = w * (float(grey[k]) - mean);
    }
    P.deviation[l] = std::sqrt(variance + M.noise);
  }
}

// Sorts the costs of the views. Returns the size of the better half of the views that see the point (cost below
// kWorst), at least 1.
inline int better_half(float* cost, int views) {
  std::sort(cost, cost + views);
  const int seen = int(std::lower_bound(cost, cost + views, kWorst) - cost);
  return std::max(1, (seen + 1) / 2);
}

// Initialises a packet: random planes where none are given, costs and chosen views.
void begin(const PatchMatch& M, Packet& P) {
  Planes planes{};
  for (int l = 0; l < kWide; ++l) {
    const float* known = M.plane + 3 * P.at[l];
    float plane[3] = {known[0], known[1], known[2]};
    if (!(plane[0] >= 0)) {
      Random random{mixed(M.seed ^ uint32_t(P.at[l]) * 0x9e3779b9u)};
      float n[3];
      random_normal(random, n);
      n[2] = std::abs(n[2]);
      plane_of(M, P.column[l], P.row[l], M.least + (M.most - M.least) * 0.5f * (1 + random.next()), n, plane);
    }
    put(planes, l, plane);
  }
  // The cost is the mean over the better half of the views, which are chosen.
  F cost[kMostSources];
  for (int v = 0; v < M.sources; ++v) cost[v] = view_cost(M, M.source[v], P, planes);
  for (int l = 0; l < P.count; ++l) {
    float sorted[kMostSources], mean = 0;
    for (int v = 0; v < M.sources; ++v) sorted[v] = cost[v][l];
    const int half = better_half(sorted, M.sources);
    uint8_t chosen = 0;
    for (int v = 0; v < half; ++v) mean += sorted[v] / float(half);
    for (int v = 0; v < M.sources; ++v) chosen |= uint8_t(cost[v][l] <= sorted[half - 1]) << v;
    float* plane = M.plane + 3 * P.at[l];
    plane[0] = planes.w[l], plane[1] = planes.x[l], plane[2] = planes.y[l];
    M.cost[P.at[l]] = mean, M.chosen[P.at[l]] = chosen;
  }
}

// Finds the candidates for propagation: from each region around a pixel the plane with the least cost, extrapolated to
// the pixel. All positions of a region have the other colour of the red-black pattern.
inline void candidates(const PatchMatch& M, const Packet& P, Planes* found) {
  // Regions 0 to 3 (near): a V of 7 pixels in each direction. Regions 4 to 7 (far): 11 pixels along each direction.
  static constexpr int direction[4][2] = {{0, -1}, {0, 1}, {-1, 0}, {1, 0}};
  for (int l = 0; l < kWide; ++l) {
    const int column = int(P.column[l]), row = int(P.row[l]);
    for (int region = 0; region < kRegions; ++region) {
      const int dx = direction[region % 4][0], dy = direction[region % 4][1];
      int best = -1;
      float least = 3 * kWorst;
      const auto offer = [&](int x, int y) {
        if (x < 0 || y < 0 || x >= M.width || y >= M.height) return;
        const int at = y * M.width + x;
        if (M.cost[at] < least) least = M.cost[at], best = at;
      };
      if (region < 4) {
        offer(column + dx, row + dy);
        for (int i = 1; i <= 3; ++i)
          for (int side = -1; side <= 1; side += 2) {
            // 1 + i along the direction and i aside: the sum is odd, so the pixel has the other colour.
            offer(column + dx * (1 + i) + dy * side * i, row + dy * (1 + i) + dx * side * i);
          }
      } else {
        for (int i = 0; i < 11; ++i) offer(column + dx * (3 + 2 * i), row + dy * (3 + 2 * i));
      }
      if (best < 0) best = P.at[l];
      const float* plane = M.plane + 3 * best;
      const float right = float(column - best % M.width), down = float(row - best / M.width);
      const float moved[3] = {std::clamp(plane[0] + plane[1] * right + plane[2] * down, M.least, M.most), plane[1],
                              plane[2]};
      put(found[region], l, moved);
    }
  }
}

// Computes the weights of the views from their costs for the candidates. A view has weight if it has more than two good
// and fewer than three bad matches: the mean weight of its good costs times a prior.
inline void choose_views(const PatchMatch& M, Packet& P, const F (*cost)[kMostSources], int number) {
  const float good = kGood * std::exp(-float(number * number) / kGoodFalls);
  for (int l = 0; l < kWide; ++l) {
    const int column = int(P.column[l]), row = int(P.row[l]);
    float total = 0, weight[kMostSources];
    for (int v = 0; v < M.sources; ++v) {
      int agree = 0, contradict = 0;
      float sum = 0;
      for (int region = 0; region < kRegions; ++region) {
        const float c = cost[region][v][l];
        if (c < good) ++agree, sum += std::exp(-c * c / (2 * kCostSpread * kCostSpread));
        if (c > kBad) ++contradict;
      }
      weight[v] = agree > 2 && contradict < 3 ? sum / float(agree) : 0;
      // Prior: higher for each of the four neighbours that chose the view.
      float prior = 0.1f;
      if (column > 0) prior += 0.225f * float(M.chosen[P.at[l] - 1] >> v & 1);
      if (column + 1 < M.width) prior += 0.225f * float(M.chosen[P.at[l] + 1] >> v & 1);
      if (row > 0) prior += 0.225f * float(M.chosen[P.at[l] - M.width] >> v & 1);
      if (row + 1 < M.height) prior += 0.225f * float(M.chosen[P.at[l] + M.width] >> v & 1);
      weight[v] *= prior, total += weight[v];
    }
    if (!(total > 0)) {  // No view has weight: the better half by least cost.
      float least[kMostSources], sorted[kMostSources];
      for (int v = 0; v < M.sources; ++v) {
        least[v] = kWorst * 2;
        for (int region = 0; region < kRegions; ++region) least[v] = std::min(least[v], cost[region][v][l]);
        sorted[v] = least[v];
      }
      const int half = better_half(sorted, M.sources);
      for (int v = 0; v < M.sources; ++v) weight[v] = float(least[v] <= sorted[half - 1]);
    }
    for (int v = 0; v < M.sources; ++v) P.view[v][l] = weight[v];
  }
}

// Performs one iteration for a packet: propagation, view selection, refinement.
void iterate(const PatchMatch& M, Packet& P, int number) {
  Planes found[kRegions], current{};
  candidates(M, P, found);
  for (int l = 0; l < kWide; ++l) put(current, l, M.plane + 3 * P.at[l]);
  F cost[kRegions][kMostSources], own[kMostSources];
  for (int region = 0; region < kRegions; ++region)
    for (int v = 0; v < M.sources; ++v) cost[region][v] = view_cost(M, M.source[v], P, found[region]);
  for (int v = 0; v < M.sources; ++v) own[v] = view_cost(M, M.source[v], P, current);
  choose_views(M, P, cost, number);
  F best = joint_cost(M, P, own);
  const auto take = [&](const Planes& planes, F planes_cost) {
    const I better = planes_cost < best;
    best = better ? planes_cost : best, current.w = better ? planes.w : current.w;
    current.x = better ? planes.x : current.x, current.y = better ? planes.y : current.y;
  };
  for (int region = 0; region < kRegions; ++region) take(found[region], joint_cost(M, P, cost[region]));
  // Refinement tries planes of inverse depth d and normal n, perturbed where marked ': (d', n), (d, n'), (d', n'),
  // (random d, n), (d, random n). d and n are those before refinement.
  const Planes old = current;
  Planes tried[kRefinements];
  const float smaller = 1 / float(1 + number);
  for (int l = 0; l < kWide; ++l) {
    Random random{mixed(M.seed ^ mixed(uint32_t(P.at[l]) * 0x9e3779b9u + uint32_t(number + 1)))};
    const float column = P.column[l], row = P.row[l], w = old.w[l];
    float n[3], turned[3], other[3], plane[3];
    normal_of(M, column, row, w, old.x[l], old.y[l], n);
    const float step = kDepthStep * smaller * std::max(w, 0.05f * M.most);
    const float moved = std::clamp(w + step * random.next(), M.least, M.most);
    float size = 0;
    for (int k = 0; k < 3; ++k) turned[k] = n[k] + kNormalStep * random.next(), size += turned[k] * turned[k];
    for (int k = 0; k < 3; ++k) turned[k] /= std::sqrt(size);
    const float anywhere = M.least + (M.most - M.least) * 0.5f * (1 + random.next());
    random_normal(random, other);
    other[2] = std::abs(other[2]);
    plane_of(M, column, row, moved, n, plane), put(tried[0], l, plane);
    plane_of(M, column, row, w, turned, plane), put(tried[1], l, plane);
    plane_of(M, column, row, moved, turned, plane), put(tried[2], l, plane);
    plane_of(M, column, row, anywhere, n, plane), put(tried[3], l, plane);
    plane_of(M, column, row, w, other, plane), put(tried[4], l, plane);
  }
  for (const Planes& planes : tried) {
    for (int v = 0; v < M.sources; ++v) own[v] = view_cost(M, M.source[v], P, planes);
    take(planes, joint_cost(M, P, own));
  }
  for (int l = 0; l < P.count; ++l) {
    float* plane = M.plane + 3 * P.at[l];
    plane[0] = current.w[l], plane[1] = current.x[l], plane[2] = current.y[l];
    M.cost[P.at[l]] = best[l];
    uint8_t chosen = 0;
    for (int v = 0; v < M.sources; ++v) chosen |= uint8_t(P.view[v][l] > 0) << v;
    M.chosen[P.at[l]] = chosen;
  }
}

// Processes the pixels of one row, packet by packet.
void row_of(const PatchMatch& M, PatchMatchStep step, int number, int row) {
  const int stride = step == PatchMatchStep::kBegin ? 1 : 2;
  const int first = step == PatchMatchStep::kBegin ? 0 : (row + (step == PatchMatchStep::kOdd)) % 2;
  Packet P;
  for (int column = first; column < M.width; column += stride * kWide) {
    P.count = std::min(kWide, (M.width - column + stride - 1) / stride);
    for (int l = 0; l < kWide; ++l) {
      const int x = column + stride * std::min(l, P.count - 1);
      P.column[l] = float(x), P.row[l] = float(row), P.at[l] = row * M.width + x;
    }
    look(M, P);
    step == PatchMatchStep::kBegin ? begin(M, P) : iterate(M, P, number);
  }
}

}  // namespace
}  // namespace LINPRIM_ISA

#define LINPRIM_JOIN2(a, b) a##b
#define LINPRIM_JOIN(a, b) LINPRIM_JOIN2(a, b)
PatchMatchKernel LINPRIM_JOIN(patch_match_kernel_, LINPRIM_ISA)() { return LINPRIM_ISA::row_of; }

}  // namespace linprim
