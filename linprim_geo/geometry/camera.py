"""Pinhole cameras, and the similarity transform between the data set's frame and the training frame.

Conventions: the camera looks along +z, x is right and y is down. Pixel (row i, column j) has its centre at (x, y) = (j
+ 0.5, i + 0.5). `depth` is z along the optical axis; `distance` is along the unit ray.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: image size, focal lengths and principal point in pixels, and a rigid pose.

    `world_to_camera` is (4, 4) float64 with an orthonormal rotation: x_camera = R x_world + t.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: np.ndarray

    @property
    def K(self) -> np.ndarray:
        """Return the (3, 3) intrinsics matrix, in pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def rotation(self) -> np.ndarray:
        """Return the (3, 3) rotation from world to camera."""
        return self.world_to_camera[:3, :3]

    @property
    def center(self) -> np.ndarray:
        """Return the (3,) position of the camera in the world."""
        return -self.rotation.T @ self.world_to_camera[:3, 3]

    @property
    def camera_to_world(self) -> np.ndarray:
        """Return the (4, 4) inverse of `world_to_camera`."""
        pose = np.eye(4)
        pose[:3, :3] = self.rotation.T
        pose[:3, 3] = self.center
        return pose

    def ray_grid(self) -> np.ndarray:
        """Return (H, W, 3) camera-space rays through the pixel centres with z = 1: a point is depth * ray."""
        x = (np.arange(self.width) + 0.5 - self.cx) / self.fx
        y = (np.arange(self.height) + 0.5 - self.cy) / self.fy
        rays = np.ones((self.height, self.width, 3))
        rays[..., 0] = x[None, :]
        rays[..., 1] = y[:, None]
        return rays

    def world_rays(self) -> np.ndarray:
        """Return the (H, W, 3) rays of `ray_grid` in world axes; a point is `center + depth * ray`."""
        return self.ray_grid() @ self.rotation

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project (P, 3) world points to (P, 2) pixel positions and (P,) depths. Positions are NaN behind the
        camera."""
        x, y, depth = self.rotation @ points.T + self.world_to_camera[:3, 3:]
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = np.where(depth > 0, 1.0 / depth, np.nan)
        pixels = np.empty((len(points), 2))
        pixels[:, 0], pixels[:, 1] = x * scale * self.fx + self.cx, y * scale * self.fy + self.cy
        return pixels, depth

    def shows(self, pixels: np.ndarray, depth: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Return (P,) bool: which of (P, 2) pixel positions with (P,) depths, as from `project`, are in front of the
        camera and inside the image, at least `margin` pixels from its border."""
        x, y = pixels.T
        with np.errstate(invalid="ignore"):
            inside = (x >= margin) & (y >= margin) & (x < self.width - margin) & (y < self.height - margin)
            return inside & (depth > 0)

    def pinhole(self) -> tuple[np.ndarray, tuple[float, float, float, float]]:
        """Return the (3, 4) world-to-camera matrix, and focal lengths and principal point, as the compiled core expects
        them."""
        return np.ascontiguousarray(self.world_to_camera[:3], np.float64), (self.fx, self.fy, self.cx, self.cy)

    def magnified(self, factor: int) -> Camera:
        """Return the same view at `factor` times the resolution."""
        return replace(
            self,
            width=self.width * factor,
            height=self.height * factor,
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx=self.cx * factor,
            cy=self.cy * factor,
        )

    def transformed(self, similarity: Similarity) -> Camera:
        """Return the same camera in the frame that `similarity` maps to."""
        pose = np.eye(4)
        pose[:3, :3] = self.rotation
        pose[:3, 3] = -self.rotation @ similarity.apply(self.center)
        return replace(self, world_to_camera=pose)


@dataclass(frozen=True)
class Similarity:
    """x_out = scale * (x_in - offset). Depths and lengths are multiplied by `scale`."""

    scale: float = 1.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Transform (..., 3) points."""
        return self.scale * (np.asarray(points, dtype=np.float64) - np.asarray(self.offset))

    def inverse(self) -> Similarity:
        """Return the inverse transform."""
        x, y, z = (float(-self.scale * value) for value in self.offset)
        return Similarity(1.0 / self.scale, (x, y, z))
