// The hot loops, compiled once per instruction set: LINPRIM_ISA is scalar, v2, v3, v4 (x86-64) or neon, and
// LINPRIM_ISA_<NAME> is 1.
//
// Everything included here lives in namespace linprim::LINPRIM_ISA. Only the two table functions at the end,
// `kernels_...` and `image_kernels_...`, are visible outside.
#ifndef LINPRIM_ISA
#error "compile this file with -DLINPRIM_ISA=<name> -DLINPRIM_ISA_<NAME>=1"
#endif

#include "raster/bin.h"
#include "raster/blend_center.h"
#include "raster/blend_overlap.h"
#include "raster/blend_sorted.h"
#include "primitives/gaussian.h"
#include "loss/image_kernels.h"
#include "raster/level_depth.h"
#include "raster/machine_limits.h"
#include "primitives/octahedron.h"
#include "primitives/tetrahedron.h"

namespace linprim {
namespace LINPRIM_ISA {

// SIMD lanes per vector.
#if defined(LINPRIM_ISA_V4)
constexpr int kWidth = 16;
#elif defined(LINPRIM_ISA_V3)
constexpr int kWidth = 8;
#elif defined(LINPRIM_ISA_SCALAR)
constexpr int kWidth = 1;
#else
constexpr int kWidth = 4;
#endif

// Returns the bytes of scratch that a thread needs for its longest tile list; enough for the larger of the two passes.
template <class Kind>
int64_t scratch_bytes(Order order, bool geometry, int64_t longest_list) {
  if (order == Order::kEntry)
    return geometry ? Window<Kind, EntryCandidate<Kind, true, true>>::bytes(longest_list)
                    : Window<Kind, EntryCandidate<Kind, true, false>>::bytes(longest_list);
  if (order == Order::kOverlap)
    return geometry ? Window<Kind, OverlapCandidate<Kind, true, true>>::bytes(longest_list)
                    : Window<Kind, OverlapCandidate<Kind, true, false>>::bytes(longest_list);
  return 0;
}

// Fills the kernel table of one primitive kind under one ray model. First index of `forward` and `backward`: centre,
// entry, overlap order.
template <class Kind>
constexpr SolidKernels<typename Kind::Real> solid_kernels(
    void (*project)(const ProjectParams<typename Kind::Real>&, int64_t, int64_t),
    void (*project_backward)(const ProjectBackwardParams<typename Kind::Real>&, int64_t, int64_t)) {
  SolidKernels<typename Kind::Real> k{};
  k.record_bytes = sizeof(typename Kind::Record);
  k.project = project, k.project_backward = project_backward;
  k.forward[0][0] = forward_center<Kind, false>, k.forward[0][1] = forward_center<Kind, true>;
  k.backward[0][0] = backward_center<Kind, false>, k.backward[0][1] = backward_center<Kind, true>;
  k.scratch_bytes = scratch_bytes<Kind>;
  for (auto& sums : k.sums_per_slot) sums[0] = Kind::kColorSums, sums[1] = Kind::kGeometrySums;
  if constexpr (Kind::kVolume) {
    k.level_depth = level_depth_tile<Kind>;
    k.sums_per_slot[2][0] = kOverlapSums<Kind, false>;
    k.forward[1][0] = forward_entry<Kind, false>, k.forward[1][1] = forward_entry<Kind, true>;
    k.backward[1][0] = backward_entry<Kind, false>, k.backward[1][1] = backward_entry<Kind, true>;
    k.forward[2][0] = forward_overlap<Kind, false>, k.forward[2][1] = forward_overlap<Kind, true>;
    k.backward[2][0] = backward_overlap<Kind, false>, k.backward[2][1] = backward_overlap<Kind, true>;
  }
  return k;
}

// Fills the table of all kernels of this instruction set.
template <class Real>
constexpr Kernels<Real> all_kernels(const char* name) {
  constexpr RayModel kExact = RayModel::kExact, kAffine = RayModel::kAffine;
  Kernels<Real> k{};
  k.name = name, k.width = kWidth, k.bin = bin<kWidth>;
  // One row per kind, in the order of PrimitiveKind; one column per ray model.
  k.solids[0][0] = solid_kernels<Octahedron<Real, kWidth, kExact>>(project_octahedra<Real, kExact>,
                                                                   project_octahedra_backward<Real, kExact>);
  k.solids[0][1] = solid_kernels<Octahedron<Real, kWidth, kAffine>>(project_octahedra<Real, kAffine>,
                                                                    project_octahedra_backward<Real, kAffine>);
  k.solids[1][0] = solid_kernels<Tetrahedron<Real, kWidth, kExact>>(project_tetrahedra<Real, kExact>,
                                                                    project_tetrahedra_backward<Real, kExact>);
  k.solids[1][1] = solid_kernels<Tetrahedron<Real, kWidth, kAffine>>(project_tetrahedra<Real, kAffine>,
                                                                     project_tetrahedra_backward<Real, kAffine>);
  k.solids[2][0] = k.solids[2][1] =
      solid_kernels<Gaussian<Real, kWidth, kAffine>>(project_gaussians<Real>, project_gaussians_backward<Real>);
  return k;
}

#define LINPRIM_STRING_(x) #x
#define LINPRIM_STRING(x) LINPRIM_STRING_(x)

template <class Real>
constexpr Kernels<Real> table = all_kernels<Real>(LINPRIM_STRING(LINPRIM_ISA));
const ImageKernels image_table = {photometric<kWidth>, adam, adam_rows<kWidth>, measure_limits<kWidth>};

}  // namespace LINPRIM_ISA

#define LINPRIM_JOIN_(a, b) a##b
#define LINPRIM_JOIN(a, b) LINPRIM_JOIN_(a, b)

#if defined(LINPRIM_ISA_SCALAR)
template <>
const Kernels<float>& kernels_scalar<float>() {
  return LINPRIM_ISA::table<float>;
}
template <>
const Kernels<double>& kernels_scalar<double>() {
  return LINPRIM_ISA::table<double>;
}
#else
const Kernels<float>& LINPRIM_JOIN(kernels_, LINPRIM_ISA)() { return LINPRIM_ISA::table<float>; }
#endif
const ImageKernels& LINPRIM_JOIN(image_kernels_, LINPRIM_ISA)() { return LINPRIM_ISA::image_table; }

}  // namespace linprim
