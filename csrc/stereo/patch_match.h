// PatchMatch stereo: finds a plane for every pixel of a photograph along which other photographs agree best.
//
// Source: Bleyer et al. 2011 (planes as hypotheses), Galliani et al. 2015 (red-black propagation), Xu and Tao 2019
// (ACMH: regions of candidates, joint view selection).
#pragma once

#include <cstdint>

namespace linprim {

constexpr int kMostSources = 8;
// The window has kWindowSide^2 samples, kWindowStep pixels apart.
constexpr int kWindowSide = 6, kWindowStep = 2;

// Pixel (column, row) has the coordinates (column, row). A plane is an inverse depth that is linear in the image: w(x +
// dx, y + dy) = w + w_x dx + w_y dy, which is exact for planes in space.
struct StereoSource {
  // Homogeneous pixel in this photograph of the reference's pixel (x, y) at inverse depth w: to (x, y, 1) + shift w.
  float to[9], shift[3];
  // The reverse mapping, from a pixel of this photograph at its inverse depth.
  float back[9], back_shift[3];
  // Grey values of 2x2 pixels in one integer: (x, y) in the lowest byte, then (x + 1, y), (x, y + 1), (x + 1, y + 1).
  const uint32_t* quads;
  const float* inverse_depth;  // (height, width) of this photograph, or null: no geometric consistency check
  int width, height;
};

struct PatchMatch {
  int width, height, sources;
  StereoSource source[kMostSources];
  const uint8_t* grey;  // (height, width)
  float focal_x, focal_y, center_x, center_y;
  float least, most;  // inverse depth
  float noise;        // variance of the noise of grey values, added to the variances of windows
  uint32_t seed;
  float* plane;     // (height, width, 3)
  float* cost;      // (height, width), 0 to 2
  uint8_t* chosen;  // (height, width) bit v: source v was chosen
};

// Writes random planes where plane[0] is NaN, then the cost of all of them.
void patch_match_begin(const PatchMatch& match);

// One iteration over all pixels: propagation, view selection, refinement. `number` counts iterations from 0. Candidates
// and perturbations depend only on it and the seed, so results are the same for any number of threads.
void patch_match_iterate(const PatchMatch& match, int number);

// Kernels in patch_match_kernel.cpp, one per instruction set: process the pixels of one row whose column + row is odd
// or even, or all.
enum class PatchMatchStep : int { kBegin, kEven, kOdd };
using PatchMatchKernel = void (*)(const PatchMatch&, PatchMatchStep, int number, int row);
PatchMatchKernel patch_match_kernel_scalar();
#if defined(__x86_64__) || defined(_M_X64)
PatchMatchKernel patch_match_kernel_v2();
PatchMatchKernel patch_match_kernel_v3();
PatchMatchKernel patch_match_kernel_v4();
#else
PatchMatchKernel patch_match_kernel_neon();
#endif

}  // namespace linprim
