// The kernels in use: selected by set_instruction_set, by the environment variable LINPRIM_GEO_ISA, or the best
// available.
#pragma once

#include "raster/kernel_table.h"

namespace linprim {

template <class Real>
const Kernels<Real>& kernels();
template <>
const Kernels<float>& kernels<float>();
template <>
const Kernels<double>& kernels<double>();
const ImageKernels& image_kernels();

}  // namespace linprim
