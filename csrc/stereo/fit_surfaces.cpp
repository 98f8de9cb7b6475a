#include "stereo/fit_surfaces.h"

#include <vector>

#include "base/copies.h"
#include "base/parallel.h"

namespace linprim {

void fit_surfaces(const uint8_t* grey, const float* plane, const float* cost, int height, int width, float tolerance,
                  float* fitted, float* fitted_cost) {
  const Crosses crosses(grey, height, width);
  const int64_t pixels = int64_t(height) * width;
  std::vector<float> inverse(plane, plane + pixels);
  inverse.resize(pixels + kRoomAfter);  // kernels read whole vectors
  const SurfaceFit fit{crosses, height,    width,  inverse.data(), plane + pixels, plane + 2 * pixels,
                       cost,    tolerance, fitted, fitted_cost};
  const SurfaceFitKernel run = kernel_in_force<SurfaceFitKernel>(LINPRIM_COPIES(surface_fit_kernel));
  parallel_for(height, [&](int64_t row, int) { run(fit, int(row)); });
}

}  // namespace linprim
