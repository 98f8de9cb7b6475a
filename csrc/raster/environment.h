// What stands behind everything: a cube map of colours at infinity, which depend on the direction of a ray alone.
#pragma once

#include <cstdint>

namespace linprim {

// A pinhole camera as far as it matters at infinity. Pixel centres at +0.5.
struct DirectionView {
  double rotation[9];  // world to camera, rows
  double fx, fy, cx, cy;
  int width, height;
};

// Texels of (6, size, size, 3). Face 2 a + (0 where coordinate a of the direction d is positive, 1 where it is
// negative) is that of the largest |d_a|; its columns go with d_b / |d_a| and its rows with d_c / |d_a| from -1 to 1, b
// and c the axes after a in cyclic order. Texel centres at +0.5. Colours are interpolated bilinearly; beyond the border
// of a face the nearest texel of its neighbour counts.
template <class Real>
struct CubeMap {
  const Real* texels;
  int size;
};

// light (3,H,W) = (1 - opacity) * colour of the pixel's direction: what reaches a camera past primitives of that
// opacity. Where 1 - opacity is below `least`, the ray has ended: 0.
template <class Real>
void environment_light(const DirectionView& view, const CubeMap<Real>& map, double least, const Real* opacity,
                       Real* light);

// Adjoint of environment_light for a map of (6, size, size, 3) texels: writes the gradient to them.
template <class Real>
void environment_light_grad(const DirectionView& view, int size, double least, const Real* opacity,
                            const Real* light_grad, Real* map_grad);

}  // namespace linprim
