// What the instruction-set builds of kernels.cpp offer to the rest of the core: plain parameter structs and tables of functions.
#pragma once

#include <cstddef>
#include <cstdint>

namespace linprim {

constexpr int kTile = 16;                       // pixels along a tile's side
constexpr int kBlock = 4;                       // pixels along a block's side; a tile has 4x4 blocks
constexpr int kBlocks = 16;                     // blocks per tile, one bit each in a pair's mask
constexpr int kTilePixels = kTile * kTile;      // stored block after block, row by row inside a block
constexpr int kMaxShCoefficients = 16;          // degree 3
constexpr int kColorSums = 16;                  // gradient sums per (tile, primitive) pair, see Sum
constexpr int kGeometrySums = 32;               // the same with the entry normals' sums (28 used)

// What the tile kernels are compiled for, beside the primitive kind, the scalar and the set of outputs.
enum class RayModel { kExact };
enum class Order { kCenter };

// A pinhole camera and what a ray does. Pixel (row, column) has its centre at (column + 0.5, row + 0.5).
struct View {
  double world_to_camera[12];  // 3x4, row major, rigid
  double fx, fy, cx, cy;       // pixels
  int width, height;           // pixels
  double near;                 // depth where rays begin, > 0
  double stop;                 // a ray ends when its transmittance is below this; 0 = never
  double level;                // transmittance at which the median depth is taken
};

// Arrays of n primitives, row major: center (n,3), rotation (n,4) as w,x,y,z of any length, extent (n,3) half-axes,
// density (n) per world unit, sh (n, sh_count, 3) with sh_count 1, 4, 9 or 16.
template <class Real>
struct Primitives {
  int64_t n;
  const Real *center, *rotation, *extent, *density, *sh;
  int sh_count;
};

// Gradients with the layout of Primitives. screen (n,3): the gradient to the centre's position in pixels, and the sum over tiles of the
// lengths of each tile's part of it, which does not cancel where a texture pulls a large primitive both ways.
template <class Real>
struct PrimitiveGradients {
  Real *center, *rotation, *extent, *density, *sh, *screen;
};

// One projected primitive, as the tile kernels read it. The faces are inverse-depth planes relative to the inverse depth w0 at
// the reference pixel: w_f(x, y) - w0 = a_f + b_f (x - ref_x) + c_f (y - ref_y) with x, y counted in pixels.
// Slots 0-3 hold, of each pair of opposite faces, the one turned to the camera; slots 4-7 their opposites, always back faces.
template <class Real>
struct alignas(64) Record {
  Real a[8], b[8], c[8];
  Real w0, density, rgb[3];
  int32_t ref_x, ref_y;
  uint32_t flags;  // bits 0-3: slot 0-3 is a front face; bit 4: take the general path (not all are, or the near plane is crossed)
  Real face[3][8];  // s_k / h_s: derivative of the face's inverse depth with respect to the local form p_k
};
constexpr uint32_t kGeneral = 16;

// Order of the gradient sums of a pair. Form k: sums of g, g (x - ref_x), g (y - ref_y) and g (w - w0) over hits, g being the
// gradient to the local form p_k; then density, colour, and, with geometry, the gradient to the unit normals of slots 0-3.
struct Sum {
  static constexpr int g = 0, gx = 3, gy = 6, gw = 9, density = 12, rgb = 13, normal = 16;
};

// Where a primitive can be seen: the inclusive box of pixels (empty: x1 < x0) and half-planes
// a + b (x - ref_x) + c (y - ref_y) > 0 whose intersection with the box holds its silhouette. `a` is already raised
// so that the test at a block's first pixel is the test of the block's most favourable pixel.
struct Footprint {
  int32_t x0, x1, y0, y1, ref_x, ref_y;
  float a[6], b[6], c[6];
};

// One primitive in one tile: which blocks it may touch (after the forward pass: does touch), and the slot of its gradient sums.
struct Pair {
  uint32_t primitive, slot, blocks;
};
// A pair before it is put into its tile's list.
struct LoosePair {
  uint32_t tile, primitive, blocks;
};

template <class Real>
struct ProjectParams {
  View view;
  Primitives<Real> primitives;
  Record<Real>* records;    // n
  Footprint* footprints;    // n
  Real* depth;              // n: depth of the centre, the key of the order
  Real* color;              // (n, 3), 0 where not visible
  Real (*normals)[4][3];    // n: outward unit normals of slots 0-3 in camera space; null without geometry
};

template <class Real>
struct ChainParams {
  View view;
  Primitives<Real> primitives;
  const Footprint* footprints;
  const Real* color;             // (n, 3) as projected
  const uint32_t* first_slot;    // n: first gradient slot of a primitive
  const uint32_t* slot_count;    // n
  const Real* sums;              // slots x sums_per_slot
  int sums_per_slot;
  PrimitiveGradients<Real> out;  // every row is written
};

// Image planes of H x W. Null pointers are allowed only where said.
template <class Real>
struct Planes {
  Real *rgb, *opacity;                       // (3,H,W), (H,W)
  Real *depth_expected, *depth_median, *depth_first, *distortion, *normal, *normal_median;  // geometry only
  Real* state;                               // (4,H,W), geometry only: reference depth, first and second moment about it, 1/(density |v|) at the median
};

template <class Real>
struct RasterParams {
  View view;
  int tiles_x, tiles_y;
  const Record<Real>* records;
  const Real (*normals)[4][3];
  const uint32_t* tile_begin;  // tiles + 1
  Pair* pairs;
  const Real* background;      // 3
  Planes<Real> out;
  Real* pair_weight;           // geometry only, per slot: largest weight
  uint32_t* pair_pixels;       // geometry only, per slot: pixels hit
  // Backward only: `out` then holds what the forward pass wrote, and `grad` the incoming gradients (null where zero).
  Planes<Real> grad;
  Real* sums;                  // per slot
  Real* background_sums;       // per tile, 3
};

// Counts of one tile's forward pass.
struct Counts {
  uint64_t visited_lanes, hit_lanes;
};

struct BinParams {
  const Footprint* footprints;
  const uint32_t* order;
  int tiles_x, tiles_y;
};

struct PhotometricParams {
  const float *image, *target;  // (3,H,W)
  const float* weight;          // (H,W) or null for all ones
  int width, height;
  float dssim;                  // weight of D-SSIM; L1 has the rest
  double weight_sum;            // sum of weight over pixels, times 3
  float* gradient;              // (3,H,W), written
};

struct AdamParams {
  float *value, *first, *second;
  const float* gradient;
  int64_t n;
  float rate, beta1, beta2, epsilon;
  float correction1, correction2;  // 1 - beta^step
};

template <class Real>
struct Kernels {
  const char* name;
  int width;
  void (*project)(const ProjectParams<Real>&, int64_t begin, int64_t end);
  void (*chain)(const ChainParams<Real>&, int64_t begin, int64_t end);
  // Appends the pairs of order[begin..end) to `out`, which has room for `capacity`; returns the index of the first primitive
  // that no longer fitted (or `end`), and the number of pairs in `written`.
  int64_t (*bin)(const BinParams&, int64_t begin, int64_t end, LoosePair* out, int64_t capacity, int64_t* written);
  Counts (*forward)(const RasterParams<Real>&, int tile, bool geometry);
  void (*backward)(const RasterParams<Real>&, int tile, bool geometry);
  // Depth at the view's transmittance level by exact overlap, into out.depth_median and out.opacity; scratch: 3 * kBlocks values per pair of the tile.
  void (*level_depth)(const RasterParams<Real>&, int tile, Real* scratch);
};

struct ImageKernels {
  // Gradient of rows [begin, end) of a channel, and their sums of |d|, d^2 and SSIM, added to `sums`. `buffer` is the calling
  // thread's own, photometric_buffer_size(width) floats.
  void (*photometric)(const PhotometricParams&, int channel, int begin, int end, float* buffer, double* sums);
  void (*adam)(const AdamParams&, int64_t begin, int64_t end);
};

constexpr int kSsimRadius = 5;
inline int64_t photometric_buffer_size(int width) { return 8 * int64_t(width + 2 * kSsimRadius + (2 * kSsimRadius + 2) * width); }

template <class Real>
const Kernels<Real>& kernels_scalar();
const ImageKernels& image_kernels_scalar();
#if defined(__x86_64__) || defined(_M_X64)
const Kernels<float>& kernels_v2();
const Kernels<float>& kernels_v3();
const Kernels<float>& kernels_v4();
const ImageKernels& image_kernels_v2();
const ImageKernels& image_kernels_v3();
const ImageKernels& image_kernels_v4();
#else
const Kernels<float>& kernels_neon();
const ImageKernels& image_kernels_neon();
#endif

}  // namespace linprim
