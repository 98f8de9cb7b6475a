// Environment light: a cube map of colours at infinity, which depend only on the direction of a ray.
#pragma once

#include <cstdint>

namespace linprim {

// A pinhole camera without its position, which does not matter at infinity. Pixel centres are at +0.5.
struct DirectionView {
  double rotation[9];  // world to camera, rows
  double fx, fy, cx, cy;
  int width, height;
};

// Texels (6, size, size, 3). Face 2 a + (0 if coordinate a of the direction d is positive, 1 if negative) contains the
// directions whose largest coordinate is |d_a|. Its columns correspond to d_b / |d_a| and its rows to d_c / |d_a| from
// -1 to 1, with b and c the axes after a in cyclic order. Texel centres are at +0.5. Colours are interpolated
// bilinearly; beyond the border of a face, the nearest texel of the neighbouring face is used.
template <class Real>
struct CubeMap {
  const Real* texels;
  int size;
};

// light (3,H,W) = (1 - opacity) * colour in the pixel's direction: the light that reaches the camera past primitives of
// that opacity. 0 where 1 - opacity is below `least`, because the ray has ended.
template <class Real>
void environment_light(const DirectionView& view, const CubeMap<Real>& map, double least, const Real* opacity,
                       Real* light);

// Adjoint of environment_light for a map of (6, size, size, 3) texels: writes the gradient to them.
template <class Real>
void environment_light_grad(const DirectionView& view, int size, double least, const Real* opacity,
                            const Real* light_grad, Real* map_grad);

}  // namespace linprim
