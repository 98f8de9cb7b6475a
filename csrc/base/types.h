// Types shared by all parts of the core: the view, primitives and their gradients, image planes.
#pragma once

#include <cstddef>
#include <cstdint>

#include "base/kinds.h"

namespace linprim {

constexpr int kTile = 16;                   // pixels along a tile's side
constexpr int kBlock = 4;                   // pixels along a block's side; a tile has 4x4 blocks
constexpr int kBlocks = 16;                 // blocks per tile, one bit each in a pair's mask
constexpr int kTilePixels = kTile * kTile;  // stored block after block, row by row inside a block
constexpr int kMaxShCoefficients = 16;      // degree 3
constexpr int kColorSums = 16;              // gradient sums per (tile, primitive) pair, see Sum
constexpr int kGeometrySums = 32;           // the same with the entry normals' sums (28 used)

// The tile kernels are compiled for each of these choices, besides the kind of primitive, the scalar type and the set
// of outputs. The numbers are used in Python too.
//
// Ray model: exact perspective, or affine: rays within a primitive are parallel in the ray space of its centre (EWA).
// Gaussians are always affine.
enum class RayModel : int { kExact, kAffine };
constexpr int kRayModels = 2;
// Blending order: by the depth of the centres; by each ray's entry depth; or overlap, where densities add up and no
// order is needed.
enum class Order : int { kCenter, kEntry, kOverlap };
constexpr int kOrders = 3;

// A pinhole camera and the parameters of its rays. Pixel (row, column) has its centre at (column + 0.5, row + 0.5).
struct View {
  double world_to_camera[12];  // 3x4, row major, rigid
  double fx, fy, cx, cy;       // pixels
  int width, height;           // pixels
  double near;                 // depth where rays begin, > 0
  double stop;                 // a ray ends when its transmittance is below this; 0 = never
  double level;                // transmittance at which the median depth is taken
  double screen_filter;        // pixels (polyhedra) or pixels^2 (Gaussians); 0 = none
  RayModel rays;
  Order order;
};

// Arrays of n primitives, row major: center (n,3), rotation (n,4) as w,x,y,z of any length, extent (n, extents()),
// density (n) per world unit, or a Gaussian's peak opacity; sh (n, sh_count, 3) with sh_count 1, 4, 9 or 16.
template <class Real>
struct Primitives {
  PrimitiveKind kind;
  int64_t n;
  const Real *center, *rotation, *extent, *density, *sh;
  int sh_count;
  int extents() const { return traits_of(kind).extents; }
};

// Gradients with the layout of Primitives. screen (n,3): the gradient to the centre's position in pixels, and the sum
// over tiles of the norm of each tile's contribution, which does not cancel where a texture pulls a large primitive in
// opposite directions.
template <class Real>
struct PrimitiveGradients {
  Real *center, *rotation, *extent, *density, *sh, *screen;
};

// Order of the gradient sums of a (tile, primitive) pair. The first twelve depend on the kind (see its add_gradient);
// then density and colour; with geometry also the gradient to the unit normals of slots 0-3 and to the distance of the
// centre, from which depths are measured.
struct Sum {
  static constexpr int g = 0, density = 12, rgb = 13, normal = 16, distance = 28;
};

// Screen bounds of a primitive: the inclusive box of pixels (empty: x1 < x0) and half-planes a + b (x - ref_x) + c (y -
// ref_y) > 0 whose intersection with the box contains its silhouette. `a` is already raised so that testing a block's
// first pixel tests the block's most favourable pixel.
struct Footprint {
  int32_t x0, x1, y0, y1, ref_x, ref_y;
  float a[6], b[6], c[6];
};

// Image planes of H x W. Null pointers are allowed only where stated.
template <class Real>
struct Planes {
  Real *rgb, *opacity;                                                                      // (3,H,W), (H,W)
  Real *depth_expected, *depth_median, *depth_first, *distortion, *normal, *normal_median;  // geometry only
  Real* state;  // (4,H,W), geometry only: reference depth, first and second moment about it, 1/(density |v|) at the
                // median
};

}  // namespace linprim
