"""Bundle adjustment of nearly correct poses: maximum a posteriori poses from observed keypoints and the given poses as
a prior.

The accuracy of the given poses is unknown; the variance of their errors is estimated from the observations (expectation
maximisation). So exact poses stay, and where observations leave poses undetermined, as along a corridor of plain walls,
they stay as given instead of bending. Source: Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000 (reduced
camera system); Dempster et al., 1977.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.feature_points import ObservedPoints

# Number of Gauss-Newton steps: for points alone, and for poses and points.
POINT_STEPS, STEPS = 10, 20
# Scale of the Cauchy loss, in standard deviations of the noise: 95 % efficient for normal errors.
CAUCHY = 2.385
# Median length of a 2D vector of two independent normal errors with standard deviation 1.
MEDIAN_LENGTH = float(np.sqrt(2 * np.log(2)))
# Lower bound of the keypoint noise, and initial guess of the pose error, both in pixels.
LEAST_NOISE, FIRST_ERROR = 0.02, 1.0
# Relative standard deviation of focal lengths that come with the poses: calibrations are accurate to some thousandths.
FOCAL_ERROR = 0.003


@dataclass(frozen=True)
class Adjusted:
    """Result of a bundle adjustment.

    `cameras`: adjusted cameras. `error_px`: root mean square error of the given poses in pixels, of rotations and
    centres together. `focal_factor`: factor of all focal lengths, with its relative standard deviation
    `focal_deviation`. `radial`: remaining radial distortion of the photographs, k1 of COLMAP's models; 0 unless it is
    asked for.
    """

    cameras: list[Camera]
    error_px: float
    focal_factor: float
    focal_deviation: float
    radial: float = 0.0


def bundle_adjusted(
    cameras: Sequence[Camera],
    points: ObservedPoints,
    *,
    common: float = 0.0,
    focal: tuple[float, float] = (1.0, FOCAL_ERROR),
    pose_error: float | None = None,
    radial_error: float = 0.0,
) -> Adjusted:
    """Return the most probable poses and focal lengths. Each of `points` needs two or more observations.

    Args:
        common: variance of an error shared by all observations of a photograph, relative to the variance of independent
            errors: n observations count as n / (1 + n common).
        focal: prior of the factor of all focal lengths, and its relative standard deviation.
        pose_error: root mean square error of the given poses in pixels; None: estimated from the observations.
        radial_error: prior standard deviation of a remaining radial distortion; 0: there is none.

    Raises:
        numpy.linalg.LinAlgError: the observations determine nothing.
    """
    from scipy.linalg import cho_factor, cho_solve

    given, points = list(cameras), placed_points(cameras, points)
    depth = _median_depths(given, points)
    usual = np.median([(camera.fx + camera.fy) / 2 for camera in given])
    # Standard deviations of rotations about an axis, in radians, and of centres along an axis, relative to depth.
    spread = np.full(2, (FIRST_ERROR if pose_error is None else pose_error) / 2 / usual)
    known, lens_error = np.log(focal[0]), np.array([focal[1], radial_error] if radial_error else [focal[1]])
    moves, lens = np.zeros((len(given), 6)), np.zeros(len(lens_error))
    moved = [_moved(camera, np.zeros(6), known) for camera in given]
    for _ in range(STEPS):
        found = _Equations(moved, points, common, radial=lens[1] if radial_error else None)
        variance = np.repeat(np.stack([np.full_like(depth, spread[0]), spread[1] * depth], 1) ** 2, 3, axis=1)
        information = np.append(1 / variance, lens_error**-2)
        reduced, right = found.reduced(information, np.append(moves, lens))
        if not np.isfinite(reduced).all():
            raise np.linalg.LinAlgError("observations behind all cameras, or at one of them")
        factor = cho_factor(reduced, check_finite=False)
        step = cho_solve(factor, right, check_finite=False)
        points = replace(points, xyz=points.xyz + found.of_points(step))
        of_lens = moves.size
        own_steps = step[:of_lens].reshape(-1, 6)
        moves, lens = moves + own_steps, lens + step[of_lens:]
        moved = [_moved(camera, own, step[of_lens]) for camera, own in zip(moved, own_steps, strict=True)]
        covariance = np.diag(cho_solve(factor, np.eye(len(reduced)), check_finite=False))
        square = moves**2 + covariance[:of_lens].reshape(-1, 6)
        square = square / np.repeat([np.ones_like(depth), depth**2], 3, axis=0).T
        if pose_error is None:
            spread = np.sqrt(square.reshape(-1, 2, 3).mean((0, 2)))
    # Only two of the three axes of each move points in the image.
    error = float(np.sqrt(2 * (spread**2).sum()) * usual)
    radial = float(lens[1]) if radial_error else 0.0
    return Adjusted(moved, error, float(np.exp(known + lens[0])), float(np.sqrt(covariance[of_lens])), radial)


def placed_points(cameras: Sequence[Camera], points: ObservedPoints) -> ObservedPoints:
    """Return the points after triangulation with fixed cameras, by Gauss-Newton steps from their current positions,
    with their mean errors."""
    for _ in range(POINT_STEPS):
        found = _Equations(cameras, points)
        points = replace(points, xyz=points.xyz + found.of_points(None))
    total = np.bincount(points.point, weights=reprojection_px(cameras, points), minlength=len(points.xyz))
    return replace(points, error_px=(total / np.maximum(points.track_length, 1)).astype(np.float32))


def reprojection_px(cameras: Sequence[Camera], points: ObservedPoints) -> np.ndarray:
    """Return (N,) reprojection errors in pixels, infinite behind the camera."""
    error = np.zeros(len(points.image))
    for k, camera in enumerate(cameras):
        rows = points.image == k
        pixels, _ = camera.project(points.xyz[points.point[rows]])
        error[rows] = np.linalg.norm(pixels - points.pixel[rows], axis=1)
    return np.nan_to_num(error, nan=np.inf)


class _Equations:
    """Normal equations of all observations, linearised at the given cameras and points. Weights come from the Cauchy
    loss and the noise variance, which is estimated from the median residual.

    A camera has six parameters: a rotation about its centre, in radians about its axes, and a shift of what it sees
    along them. Shared parameters follow: the log factor of all focal lengths and, if `radial` (its current value) is
    given, the radial distortion of all photographs.
    """

    def __init__(
        self, cameras: Sequence[Camera], points: ObservedPoints, common: float = 0.0, radial: float | None = None
    ):
        self.image, self.point = points.image, points.point
        self.cameras, self.points = len(cameras), len(points.xyz)
        turn = np.array([camera.rotation for camera in cameras])[self.image]
        shift = np.array([camera.world_to_camera[:3, 3] for camera in cameras])[self.image]
        inner = np.array([(camera.fx, camera.fy, camera.cx, camera.cy) for camera in cameras])[self.image].T
        local = np.einsum("nij,nj->ni", turn, points.xyz[self.point]) + shift
        x, y, z = local.T
        front = z > 0
        z = np.where(front, z, 1)
        by_lens = np.stack([inner[0] * x / z, inner[1] * y / z], 1)[..., None]
        if radial is not None:
            square = ((x**2 + y**2) / z**2)[:, None, None]
            by_lens = np.concatenate([by_lens * (1 + radial * square), by_lens * square], 2)
        self.by_lens = by_lens
        miss = points.pixel - by_lens[..., 0] - inner[2:].T
        if points.precision is not None:
            miss = np.einsum("nij,nj->ni", points.precision, miss)
            self.by_lens = points.precision @ by_lens
        length = np.linalg.norm(miss, axis=1)
        noise = max(float(np.median(length[front])) / MEDIAN_LENGTH, LEAST_NOISE) if front.any() else 1.0
        together = 1 + np.bincount(self.image, minlength=self.cameras)[self.image] * common
        weight = np.where(front, 1 / (1 + (length / (CAUCHY * noise)) ** 2) / (together * noise**2), 0)
        zero = np.zeros_like(z)
        by_local = np.stack([inner[0] / z, zero, -inner[0] * x / z**2, zero, inner[1] / z, -inner[1] * y / z**2], 1)
        by_local = by_local.reshape(-1, 2, 3)
        if points.precision is not None:
            by_local = points.precision @ by_local
        cross = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], 1).reshape(-1, 3, 3)  # d(turn x local) / d turn
        self.by_camera = np.concatenate([by_local @ cross, by_local], axis=2)
        self.by_point = by_local @ turn
        self.weight, self.miss = weight, miss
        self.point_matrix = np.zeros((self.points, 3, 3))
        weighted = weight[:, None, None] * self.by_point
        np.add.at(self.point_matrix, self.point, np.einsum("nki,nkj->nij", weighted, self.by_point))
        self.point_right = np.zeros((self.points, 3))
        np.add.at(self.point_right, self.point, np.einsum("nki,nk->ni", weighted, miss))
        # Damping, so that points with parallel rays do not run away along them.
        damping = 1e-6 * np.trace(self.point_matrix, axis1=1, axis2=2) + 1e-300
        self.point_inverse = np.linalg.inv(self.point_matrix + damping[:, None, None] * np.eye(3))

    def reduced(self, information: np.ndarray, moves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the reduced camera system, with points eliminated: a (6 K + L, 6 K + L) matrix and the right side, for
        K cameras and L shared lens parameters.

        `information` (6 K + L,) is the prior's inverse variance; `moves` (6 K + L,) are the changes so far from the
        prior's mean.
        """
        from scipy.sparse import bsr_matrix

        weighted, of_lens = self.weight[:, None, None] * self.by_camera, self.weight[:, None, None] * self.by_lens
        own, both_kinds = np.zeros((self.cameras, 6, 6)), np.zeros((self.cameras, 6, self.by_lens.shape[2]))
        np.add.at(own, self.image, np.einsum("nki,nkj->nij", weighted, self.by_camera))
        np.add.at(both_kinds, self.image, np.einsum("nki,nkj->nij", self.by_camera, of_lens))
        right = np.zeros((self.cameras, 6))
        np.add.at(right, self.image, np.einsum("nki,nk->ni", weighted, self.miss))
        # One block row per observation: the Jacobian block of its camera times that of its point.
        order, both = np.argsort(self.image, kind="stable"), np.einsum("nki,nkj->nij", weighted, self.by_point)
        bounds = np.searchsorted(self.image[order], np.arange(self.cameras + 1))
        shape = (6 * self.cameras, 3 * self.points)
        mixed = bsr_matrix((both[order], self.point[order], bounds), shape=shape)
        solved = np.einsum("nij,njk->nik", both, self.point_inverse[self.point])
        solved = bsr_matrix((solved[order], self.point[order], bounds), shape=shape)
        mixed_lens = np.zeros((self.points, 3, self.by_lens.shape[2]))
        np.add.at(mixed_lens, self.point, np.einsum("nki,nkj->nij", self.by_point, of_lens))
        solved_lens = np.einsum("pij,pjl->pil", self.point_inverse, mixed_lens).reshape(shape[1], -1)
        matrix, count = np.diag(information), shape[0]
        matrix[:count, :count] -= (solved @ mixed.T).toarray()
        for k in range(self.cameras):
            matrix[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += own[k]
        matrix[:count, count:] = both_kinds.reshape(count, -1) - mixed @ solved_lens
        matrix[count:, :count] = matrix[:count, count:].T
        mixed_lens = mixed_lens.reshape(shape[1], -1)
        matrix[count:, count:] += np.einsum("nki,nkj->ij", of_lens, self.by_lens) - mixed_lens.T @ solved_lens
        right = (right - (solved @ self.point_right.ravel()).reshape(-1, 6)).ravel()
        lens_right = np.einsum("nki,nk->i", of_lens, self.miss) - solved_lens.T @ self.point_right.ravel()
        return matrix, np.append(right, lens_right) - information * moves

    def of_points(self, step: np.ndarray | None) -> np.ndarray:
        """Return the (P, 3) step of the points for a (6 K + L,) step of the cameras and the lens, or None for no
        step."""
        right = self.point_right
        if step is not None:
            right, count = right.copy(), 6 * self.cameras
            moved = np.einsum("nkj,nj->nk", self.by_camera, step[:count].reshape(-1, 6)[self.image])
            moved = (moved + self.by_lens @ step[count:]) * self.weight[:, None]
            np.subtract.at(right, self.point, np.einsum("nki,nk->ni", self.by_point, moved))
        return np.einsum("pij,pj->pi", self.point_inverse, right)


def _median_depths(cameras: Sequence[Camera], points: ObservedPoints) -> np.ndarray:
    """Return (K,) the median depth of the points that each camera sees, or of all points if it sees none."""
    depths = [camera.project(points.xyz[points.point[points.image == k]])[1] for k, camera in enumerate(cameras)]
    usual = float(np.median(np.concatenate(depths)))
    return np.array([max(float(np.median(own)), 1e-3 * usual) if len(own) else usual for own in depths])


def _moved(camera: Camera, step: np.ndarray, log_factor: float = 0.0) -> Camera:
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    pose[:3, :3] = turn @ camera.rotation
    pose[:3, 3] = turn @ camera.world_to_camera[:3, 3] + step[3:]
    factor = float(np.exp(log_factor))
    return replace(camera, fx=factor * camera.fx, fy=factor * camera.fy, world_to_camera=pose)
