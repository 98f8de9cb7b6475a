// Interface of the core: an exact, differentiable rasterizer of transparent polyhedra, an image loss and an optimiser
// step.
//
// Plain functions on plain arrays; no Python, no torch, no exceptions of its own (std::bad_alloc passes through).
// Callers must satisfy the preconditions (bind/ checks them). All functions use every thread of the pool
// (base/parallel.h) and give bitwise the same result for any number of threads.
#pragma once

#include <cstdint>

#include "raster/kernel_table.h"

namespace linprim {

// Selects the vector kernels: "scalar", "v2", "v3", "v4", "neon", or "auto" for the best that this processor supports.
// Returns false, and changes nothing, if the processor or the build has no such kernels. Double precision is always
// scalar.
bool set_instruction_set(const char* name);
const char* instruction_set();

// Counts and times of the last forward and backward pass.
struct Statistics {
  int64_t primitives, visible, pairs, visited_lanes, hit_lanes, working_set_bytes;
  double project_ms, sort_ms, bin_ms, forward_ms, backward_ms,
      project_backward_ms;  // project: with the search for the tiles, bin: without
};
Statistics statistics();

// Whether primitives of this kind can be rendered with this ray model in this order (a Gaussian has no entry point, so
// only by centre).
template <class Real>
bool has_kernels(PrimitiveKind kind, RayModel rays, Order order);

// Measures the speed of the calling thread's core for some milliseconds, with the instruction set in use.
Limits measure_limits();

// Renders `primitives` with the view's ray model and order.
//
// out.rgb and out.opacity are always written; with `geometry`, so are the other planes, max_weight (n), the largest
// blending weight T alpha of a primitive in any pixel, and pixels (n), the number of pixels that hit it. color (n,3)
// receives the view-dependent colour of each primitive that may be visible, 0 for the others. `background` has 3
// values.
template <class Real>
void rasterize(const View& view, const Primitives<Real>& primitives, const Real* background, bool geometry,
               const Planes<Real>& out, Real* color, Real* max_weight, int32_t* pixels);

// Backward pass of rasterize for the same arguments: `out` and `color` as that call wrote them, `grad` the gradients to
// its planes (null where zero). Writes every row of `gradients` and the 3 values of background_grad. Tile lists are
// reused if the forward pass is among the last few and had the same content; otherwise they are rebuilt.
template <class Real>
void rasterize_grad(const View& view, const Primitives<Real>& primitives, const Real* background, bool geometry,
                    const Planes<Real>& out, const Real* color, const Planes<Real>& grad,
                    const PrimitiveGradients<Real>& gradients, Real* background_grad);

// Writes the z-depth (H,W) at which the transmittance of each pixel's ray falls to view.level; 0 where it never does.
// Densities add up where primitives overlap, so no order is needed. opacity (H,W): 1 - transmittance of the whole ray.
template <class Real>
void level_depth(const View& view, const Primitives<Real>& primitives, Real* depth, Real* opacity);

// loss = (1 - dssim) L1 + dssim (1 - SSIM) of two (3,H,W) images, and its gradient to the first, written to `gradient`
// (3,H,W). `weight` (H,W) or null multiplies both maps; the means are weighted by it. Returns the loss, its two parts
// and the mean squared error.
struct Photometric {
  double loss, l1, ssim, mse;
};
Photometric photometric_loss(const float* image, const float* target, const float* weight, int width, int height,
                             float dssim, float* gradient);

// Averages `factor` x `factor` pixels of `planes` images (height factor) x (width factor) -> height x width; the
// adjoint gives each pixel 1 / factor^2 of its mean's gradient. Sizes are those of the small image.
template <class Real>
void average_pixels(const Real* fine, int planes, int width, int height, int factor, Real* coarse);
template <class Real>
void average_pixels_grad(const Real* coarse_grad, int planes, int width, int height, int factor, Real* fine_grad);

// One Adam step (Kingma and Ba 2015, algorithm 1) on n values, in place; `step` counts from 1.
void adam_step(float* value, const float* gradient, float* first, float* second, int64_t n, float rate, float beta1,
               float beta2, float epsilon, int64_t step);

// One Adam step, in one pass, on the touched rows of several tensors of n rows each. The step count of a touched row,
// in `steps` (n), increases by one and is used for its bias correction: the row gets exactly the Adam updates of the
// steps that touched it. Values, moments and counts of the other rows are unchanged. `touched` (n) or null: the rows
// where any tensor has a non-zero gradient.
void adam_rows(const RowTensor* tensors, int count, int64_t n, const uint8_t* touched, int32_t* steps, float beta1,
               float beta2, float epsilon);

// Returns the index of the first value that is NaN or infinite, or -1.
template <class Real>
int64_t first_non_finite(const Real* values, int64_t n);

}  // namespace linprim
