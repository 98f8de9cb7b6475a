// Real spherical harmonics up to degree 3 and their derivatives, for any number type.
//
// Signs and order are those of 3D Gaussian splatting's files: degree 1 is -y, z, -x. The constants are the orthonormal
// ones, K_l^m = sqrt((2l+1)/(4 pi) (l-|m|)!/(l+|m|)!) times sqrt(2) for m != 0, expanded in Cartesian form.
#pragma once

namespace linprim::LINPRIM_ISA {

constexpr double kSh0 = 0.28209479177387814;  // 1/2 sqrt(1/pi)
constexpr double kSh1 = 0.48860251190291992;  // 1/2 sqrt(3/pi)
constexpr double kSh2[3] = {1.0925484305920792, 0.31539156525252005,
                            0.54627421529603959};  // 1/2 sqrt(15/pi), 1/4 sqrt(5/pi), 1/4 sqrt(15/pi)
constexpr double kSh3[5] = {0.59004358992664352, 2.8906114426405538, 0.45704579946446572, 0.3731763325901154,
                            1.4453057213202769};
// 1/4 sqrt(35/(2 pi)), 1/2 sqrt(105/pi), 1/4 sqrt(21/(2 pi)), 1/4 sqrt(7/pi), 1/4 sqrt(105/pi)

// out[0..count) = basis functions at the unit vector (x, y, z); count is 1, 4, 9 or 16.
template <class T>
inline void sh_basis(int count, T x, T y, T z, T* out) {
  out[0] = kSh0 + (x - x);
  if (count < 4) return;
  out[1] = -kSh1 * y, out[2] = kSh1 * z, out[3] = -kSh1 * x;
  if (count < 9) return;
  const T xx = x * x, yy = y * y, zz = z * z;
  out[4] = kSh2[0] * x * y, out[5] = -kSh2[0] * y * z, out[6] = kSh2[1] * (2.0 * zz - xx - yy);
  out[7] = -kSh2[0] * x * z, out[8] = kSh2[2] * (xx - yy);
  if (count < 16) return;
  out[9] = -kSh3[0] * y * (3.0 * xx - yy), out[10] = kSh3[1] * x * y * z, out[11] = -kSh3[2] * y * (4.0 * zz - xx - yy);
  out[12] = kSh3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy), out[13] = -kSh3[2] * x * (4.0 * zz - xx - yy);
  out[14] = kSh3[4] * z * (xx - yy), out[15] = -kSh3[0] * x * (xx - 3.0 * yy);
}

// out[i] = gradient of basis function i as a polynomial in (x, y, z).
template <class T>
inline void sh_basis_grad(int count, T x, T y, T z, T out[][3]) {
  const T zero = x - x;
  out[0][0] = out[0][1] = out[0][2] = zero;
  if (count < 4) return;
  out[1][0] = zero, out[1][1] = zero - kSh1, out[1][2] = zero;
  out[2][0] = zero, out[2][1] = zero, out[2][2] = zero + kSh1;
  out[3][0] = zero - kSh1, out[3][1] = zero, out[3][2] = zero;
  if (count < 9) return;
  const T xx = x * x, yy = y * y, zz = z * z;
  out[4][0] = kSh2[0] * y, out[4][1] = kSh2[0] * x, out[4][2] = zero;
  out[5][0] = zero, out[5][1] = -kSh2[0] * z, out[5][2] = -kSh2[0] * y;
  out[6][0] = -2.0 * kSh2[1] * x, out[6][1] = -2.0 * kSh2[1] * y, out[6][2] = 4.0 * kSh2[1] * z;
  out[7][0] = -kSh2[0] * z, out[7][1] = zero, out[7][2] = -kSh2[0] * x;
  out[8][0] = 2.0 * kSh2[2] * x, out[8][1] = -2.0 * kSh2[2] * y, out[8][2] = zero;
  if (count < 16) return;
  out[9][0] = -6.0 * kSh3[0] * x * y, out[9][1] = -3.0 * kSh3[0] * (xx - yy), out[9][2] = zero;
  out[10][0] = kSh3[1] * y * z, out[10][1] = kSh3[1] * x * z, out[10][2] = kSh3[1] * x * y;
  out[11][0] = 2.0 * kSh3[2] * x * y, out[11][1] = -kSh3[2] * (4.0 * zz - xx - 3.0 * yy),
  out[11][2] = -8.0 * kSh3[2] * y * z;
  out[12][0] = -6.0 * kSh3[3] * x * z, out[12][1] = -6.0 * kSh3[3] * y * z,
  out[12][2] = kSh3[3] * (6.0 * zz - 3.0 * xx - 3.0 * yy);
  out[13][0] = -kSh3[2] * (4.0 * zz - 3.0 * xx - yy), out[13][1] = 2.0 * kSh3[2] * x * y,
  out[13][2] = -8.0 * kSh3[2] * x * z;
  out[14][0] = 2.0 * kSh3[4] * x * z, out[14][1] = -2.0 * kSh3[4] * y * z, out[14][2] = kSh3[4] * (xx - yy);
  out[15][0] = -3.0 * kSh3[0] * (xx - yy), out[15][1] = 6.0 * kSh3[0] * x * y, out[15][2] = zero;
}

}  // namespace linprim::LINPRIM_ISA
