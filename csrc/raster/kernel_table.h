// Interface of the instruction-set builds of kernels.cpp to the rest of the core: plain parameter structs and tables of
// functions.
#pragma once

#include "base/types.h"

namespace linprim {

// Tile lists: the primitives of all tiles, tile by tile, each tile's in order; the blocks of the tile that each
// primitive may touch (after a centre-ordered forward pass: does touch); and the slot of its gradient sums. tile_begin
// has tiles + 1 entries.
struct TileLists {
  const uint32_t *tile_begin, *primitive, *slot;
  uint32_t* blocks;
};
// A (primitive, tile) pair before it is sorted into its tile's list.
struct LoosePair {
  uint32_t tile, blocks;
};

template <class Real>
struct ProjectParams {
  View view;
  Primitives<Real> primitives;
  void* records;          // n of the kind's records
  Footprint* footprints;  // n
  Real* key;              // n: depth of the centre; for the other orders a lower bound of all the primitive's depths
  Real* color;            // (n, 3), 0 where not visible
  Real (*normals)[4][3];  // n: outward unit normals of slots 0-3 in camera space (a Gaussian has one); null without
                          // geometry
};

template <class Real>
struct ProjectBackwardParams {
  View view;
  Primitives<Real> primitives;
  const Footprint* footprints;
  const Real* color;           // (n, 3) as projected
  const uint32_t* first_slot;  // n: first gradient slot of a primitive
  const uint32_t* slot_count;  // n
  const Real* sums;            // slots x sums_per_slot
  int sums_per_slot;
  PrimitiveGradients<Real> out;  // every row is written
};

template <class Real>
struct RasterParams {
  View view;
  int tiles_x, tiles_y;
  const void* records;  // of the kind
  const Real* key;      // per primitive, see ProjectParams
  const Real (*normals)[4][3];
  TileLists lists;
  const Real* background;  // 3
  Planes<Real> out;
  Real* pair_weight;      // geometry only, per slot: largest weight
  uint32_t* pair_pixels;  // geometry only, per slot: pixels hit
  // Backward only: `out` then holds the results of the forward pass, and `grad` the incoming gradients (null where
  // zero).
  Planes<Real> grad;
  Real* sums;             // per slot
  Real* background_sums;  // per tile, 3
};

// Counts of one tile's forward pass.
struct Counts {
  uint64_t visited_lanes, hit_lanes;
};

struct BinParams {
  const Footprint* footprints;
  const uint32_t* visible;  // rows
  int tiles_x;
  uint32_t* slot_count;  // per row, written for the visible ones: number of pairs
  uint32_t* tile_count;  // per tile, added to: number of pairs
};

struct PhotometricParams {
  const float *image, *target;  // (3,H,W)
  const float* weight;          // (H,W) or null for all ones
  int width, height;
  float dssim;        // weight of D-SSIM; L1 has the rest
  double weight_sum;  // sum of weight over pixels, times 3
  float* gradient;    // (3,H,W), written
};

struct AdamParams {
  float *value, *first, *second;
  const float* gradient;
  int64_t n;
  float rate, beta1, beta2, epsilon;
  float correction1, correction2;  // 1 - beta^step
};

constexpr int kAdamRows = 512;  // rows per call of adam_rows at most
// One tensor of adam_rows: rows of `columns` floats.
struct RowTensor {
  float *value, *first, *second;
  const float* gradient;
  int64_t columns;
  float rate;
};
struct AdamRowsParams {
  const RowTensor* tensors;
  int count;
  const uint8_t* touched;  // per row, or null: the rows with a gradient that is not 0
  int32_t* steps;          // per row, incremented where touched
  float beta1, beta2, epsilon;
  const float *inverse, *root;  // 1 / (1 - beta1^t), 1 / sqrt(1 - beta2^t) for t < table_size
  int64_t table_size;
  bool table_complete;  // beyond the table both are 1
};

// Kernels of one primitive kind under one ray model.
template <class Real>
struct SolidKernels {
  int64_t record_bytes;
  void (*project)(const ProjectParams<Real>&, int64_t begin, int64_t end);
  void (*project_backward)(const ProjectBackwardParams<Real>&, int64_t begin, int64_t end);
  // By order and set of outputs (colour; colour and geometry); null if the kind does not support the order. `scratch`
  // belongs to the calling thread: scratch_bytes(longest tile list) bytes, 64-byte aligned.
  Counts (*forward[kOrders][2])(const RasterParams<Real>&, int tile, void* scratch);
  void (*backward[kOrders][2])(const RasterParams<Real>&, int tile, void* scratch);
  int64_t (*scratch_bytes)(Order, bool geometry, int64_t longest_list);
  int sums_per_slot[kOrders][2];
  // Depth at the view's transmittance level with exact overlap, into out.depth_median and out.opacity; scratch: 3 *
  // kBlocks values per pair of the tile. Null for Gaussians.
  void (*level_depth)(const RasterParams<Real>&, int tile, Real* scratch);
};

// Current speed of one core, see machine_limits.h.
struct Limits {
  double fma_gflops;                         // multiply-adds count as two
  double exp_ns;                             // per value: alpha and transmittance
  double pair_forward_ns, pair_backward_ns;  // per (pixel, primitive) of octahedra, exact rays
};

template <class Real>
struct Kernels {
  const char* name;
  int width;
  SolidKernels<Real> solids[kKinds][kRayModels];
  // Appends the pairs of visible[begin..end), each primitive's tile rows from top to bottom, to `out`, which has room
  // for `capacity`. Returns the index of the first primitive that did not fit (or `end`); `written` receives the number
  // of pairs.
  int64_t (*bin)(const BinParams&, int64_t begin, int64_t end, LoosePair* out, int64_t capacity, int64_t* written);
};

struct ImageKernels {
  // Computes the gradient of rows [begin, end) of a channel in one of its photometric_tiles(width) tiles of columns;
  // adds each row's sums of weight times |d|, d^2 and 1 - SSIM to row_sums (H,3). A row's results do not depend on the
  // other rows of the call. `buffer` belongs to the calling thread: photometric_buffer_size(width) floats.
  void (*photometric)(const PhotometricParams&, int channel, int tile, int begin, int end, float* buffer,
                      double* row_sums);
  void (*adam)(const AdamParams&, int64_t begin, int64_t end);
  void (*adam_rows)(const AdamRowsParams&, int64_t begin, int64_t end);
  Limits (*limits)();
};

constexpr int kSsimRadius = 5;
constexpr int kSsimRows = 8;           // blurred along y together
constexpr int kSsimAlign = 16;         // floats of a cache line
constexpr int kSsimMaxColumns = 1024;  // so that the rows of a tile's maps stay in the second-level cache
inline int photometric_columns(int width) {
  const int tiles = (width + kSsimMaxColumns - 1) / kSsimMaxColumns;
  return ((width + tiles - 1) / tiles + kSsimAlign - 1) / kSsimAlign * kSsimAlign;
}
inline int photometric_tiles(int width) {
  return (width + photometric_columns(width) - 1) / photometric_columns(width);
}
// Floats per row of a tile: two extra cache lines on either side, and an odd number of lines, which distributes the
// rows over the cache.
inline int64_t photometric_pitch(int width) { return ((photometric_columns(width) / kSsimAlign + 4) | 1) * kSsimAlign; }
inline int64_t photometric_buffer_size(int width) {
  return ((4 + 3) * 3 * kSsimRows + 4 * kSsimRows + 2) * photometric_pitch(width) + kSsimAlign;
}

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
