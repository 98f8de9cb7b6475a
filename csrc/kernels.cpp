// The hot loops, compiled once per instruction set: LINPRIM_ISA is scalar, v2, v3, v4 (x86-64) or neon, and LINPRIM_ISA_<NAME> is 1.
//
// Everything included here lives in namespace linprim::LINPRIM_ISA. Only the two table functions at the end are seen outside.
#ifndef LINPRIM_ISA
#error "compile this file with -DLINPRIM_ISA=<name> -DLINPRIM_ISA_<NAME>=1"
#endif

#include "bin.h"
#include "image_kernels.h"
#include "project.h"
#include "raster.h"

namespace linprim {
namespace LINPRIM_ISA {

#if defined(LINPRIM_ISA_V4)
constexpr int kWidth = 16;
#elif defined(LINPRIM_ISA_V3)
constexpr int kWidth = 8;
#elif defined(LINPRIM_ISA_SCALAR)
constexpr int kWidth = 1;
#else
constexpr int kWidth = 4;
#endif

template <class Real>
using Solid = Octahedron<Real, kWidth, RayModel::kExact>;

template <class Real>
Counts forward(const RasterParams<Real>& P, int tile, bool geometry) {
  return geometry ? forward_tile<Solid<Real>, Order::kCenter, true>(P, tile) : forward_tile<Solid<Real>, Order::kCenter, false>(P, tile);
}

template <class Real>
void backward(const RasterParams<Real>& P, int tile, bool geometry) {
  geometry ? backward_tile<Solid<Real>, Order::kCenter, true>(P, tile) : backward_tile<Solid<Real>, Order::kCenter, false>(P, tile);
}

#define LINPRIM_STRING_(x) #x
#define LINPRIM_STRING(x) LINPRIM_STRING_(x)

template <class Real>
const Kernels<Real> table = {LINPRIM_STRING(LINPRIM_ISA), kWidth,         project<Real>, chain<Real>,
                             bin<kWidth>,                 forward<Real>, backward<Real>,
                             level_depth_tile<Solid<Real>>};
const ImageKernels image_table = {photometric<kWidth>, adam};

}  // namespace LINPRIM_ISA

#define LINPRIM_JOIN_(a, b) a##b
#define LINPRIM_JOIN(a, b) LINPRIM_JOIN_(a, b)

#if defined(LINPRIM_ISA_SCALAR)
template <>
const Kernels<float>& kernels_scalar<float>() { return LINPRIM_ISA::table<float>; }
template <>
const Kernels<double>& kernels_scalar<double>() { return LINPRIM_ISA::table<double>; }
#else
const Kernels<float>& LINPRIM_JOIN(kernels_, LINPRIM_ISA)() { return LINPRIM_ISA::table<float>; }
#endif
const ImageKernels& LINPRIM_JOIN(image_kernels_, LINPRIM_ISA)() { return LINPRIM_ISA::image_table; }

}  // namespace linprim
