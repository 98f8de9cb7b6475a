"""Consistency of depth maps: reprojection error, relative difference of depths and parallax of each pixel in another
view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from linprim_geo.geometry.camera import Camera

# Another view confirms a depth if the reprojection error, in pixels, and the relative difference of the depths are
# below these.
CONFIRMED_PX, CONFIRMED_DEPTH = 1.0, 0.01


@dataclass(frozen=True)
class ViewConsistency:
    """The depths of one view compared with another view, each (H, W) float32 unless noted.

    `pixel` int32 is the index of the pixel in the other view, row by row, -1 outside; `reprojection_error` is the
    forward-backward one in pixels, via the surface found by the other view, infinite where it has none;
    `depth_difference` the relative difference of both depths; `parallax` the derivative of the position in the other
    view, in pixels, by the logarithm of the depth.
    """

    pixel: np.ndarray
    reprojection_error: np.ndarray
    depth_difference: np.ndarray
    parallax: np.ndarray

    @property
    def confirms(self) -> np.ndarray:
        """(H, W) bool: depths that the other view confirms."""
        return (self.reprojection_error < CONFIRMED_PX) & (np.abs(self.depth_difference) < CONFIRMED_DEPTH)


def compare_depths(camera: Camera, depth: np.ndarray, other: Camera, plane: np.ndarray) -> ViewConsistency:
    """Compare (H, W) depths of `camera` with the view `other`, whose `plane` (3, H', W') holds inverse depths and their
    slopes."""
    pixel = np.full(depth.shape, -1, np.int32)
    reprojection_error, parallax = np.full(depth.shape, np.inf, np.float32), np.zeros(depth.shape, np.float32)
    depth_difference = reprojection_error.copy()
    rows, columns = np.nonzero(np.isfinite(depth) & (depth > 0))
    own = depth[rows, columns].astype(np.float64)
    pose = other.world_to_camera @ camera.camera_to_world
    rays = np.stack([(columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy, np.ones(len(own))])
    turned = pose[:3, :3] @ (rays * own)
    x, y, z = turned + pose[:3, 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = other.fx * x / z + other.cx, other.fy * y / z + other.cy
        seen = (z > 0) & (u >= 0) & (v >= 0) & (u < other.width) & (v < other.height)
    rows, columns, own, u, v, x, y, z = (each[seen] for each in (rows, columns, own, u, v, x, y, z))
    # d(x / z) / d ln(depth), and the same of y.
    grows = turned[:, seen]
    parallax[rows, columns] = np.hypot(
        other.fx * (grows[0] - x / z * grows[2]) / z, other.fy * (grows[1] - y / z * grows[2]) / z
    )
    column, row = u.astype(np.int64), v.astype(np.int64)
    pixel[rows, columns] = row * other.width + column
    w, w_x, w_y = plane[:, row, column]
    inverse = w + w_x * (u - column - 0.5) + w_y * (v - row - 0.5)
    known = inverse > 0  # false for NaN
    rows, columns, own, u, v, inverse = (each[known] for each in (rows, columns, own, u, v, inverse))
    points = np.stack([(u - other.cx) / other.fx, (v - other.cy) / other.fy, np.ones(len(u))]) / inverse
    x, y, z = pose[:3, :3].T @ (points - pose[:3, 3:])
    with np.errstate(divide="ignore", invalid="ignore"):
        back = np.hypot(camera.fx * x / z + camera.cx - columns - 0.5, camera.fy * y / z + camera.cy - rows - 0.5)
    reprojection_error[rows, columns] = np.where(z > 0, back, np.inf)
    depth_difference[rows, columns] = z / own - 1
    return ViewConsistency(pixel, reprojection_error, depth_difference, parallax)
