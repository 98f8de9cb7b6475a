"""Cameras with errors of poses and focal lengths, as from structure from motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from linprim_geo.geometry.camera import Camera

SEED = 10
"""Separates the random numbers of the poses from those of other parts of a capture."""


def reported(
    cameras: list[Camera], error_px: float, focal_error: float, distance: float, seed: tuple[int, ...]
) -> list[Camera]:
    """Return the cameras with independent errors of their poses and a common error of their focal lengths.

    Errors of rotation and position are normally distributed. They move a point at `distance` in the middle of the image
    by `error_px` pixels (root mean square of the distance); each contributes half of the variance.

    Args:
        error_px: root mean square distance in the image, pixels.
        focal_error: relative; 0.005 reports focal lengths that are 0.5 % too long.
        distance: typical depth of the surface, world units.
        seed: of the errors.
    """
    rng = np.random.default_rng(seed)
    told = []
    for camera in cameras:
        # Two of the three axes of a rotation, and of a translation, move the middle of the image.
        per_axis = error_px / 2.0
        angles = rng.standard_normal(3) * per_axis / camera.fx
        shift = rng.standard_normal(3) * per_axis * distance / camera.fx
        pose = camera.world_to_camera.copy()
        pose[:3, :3] = _rotation(angles) @ pose[:3, :3]
        pose[:3, 3] = _rotation(angles) @ pose[:3, 3] + shift
        scale = 1.0 + focal_error
        told.append(replace(camera, world_to_camera=pose, fx=camera.fx * scale, fy=camera.fy * scale))
    return told


def _rotation(vector: np.ndarray) -> np.ndarray:
    """Return the (3, 3) rotation about a vector by its length in radians."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vector).as_matrix()
