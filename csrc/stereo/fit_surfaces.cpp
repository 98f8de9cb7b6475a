#include "stereo/fit_surfaces.h"

#include <cstring>
#include <vector>

#include "base/parallel.h"
#include "linprim.h"

namespace linprim {
namespace {

SurfaceFitKernel kernel() {
  const char* name = instruction_set();
#if defined(__x86_64__) || defined(_M_X64)
  if (std::strcmp(name, "v4") == 0) return surface_fit_kernel_v4();
  if (std::strcmp(name, "v3") == 0) return surface_fit_kernel_v3();
  if (std::strcmp(name, "v2") == 0) return surface_fit_kernel_v2();
#else
  if (std::strcmp(name, "neon") == 0) return surface_fit_kernel_neon();
#endif
  return surface_fit_kernel_scalar();
}

}  // namespace

void fit_surfaces(const uint8_t* grey, const float* plane, const float* cost, int height, int width, float tolerance,
                  float* fitted, float* fitted_cost) {
  const Crosses crosses(grey, height, width);
  const int64_t pixels = int64_t(height) * width;
  std::vector<float> inverse(plane, plane + pixels);
  inverse.resize(pixels + kRoomAfter);
  const SurfaceFit fit{crosses, height,    width,  inverse.data(), plane + pixels, plane + 2 * pixels,
                       cost,    tolerance, fitted, fitted_cost};
  const SurfaceFitKernel run = kernel();
  parallel_for(height, [&](int64_t row, int) { run(fit, int(row)); });
}

}  // namespace linprim
