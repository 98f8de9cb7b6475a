"""Photographs of a cubic room seen from inside, with a texture for keypoint detection and exactly known cameras."""

from __future__ import annotations

import numpy as np

HALF = 2.0  # half the side of the room


def wall_texture(points: np.ndarray) -> np.ndarray:
    """Returns (..., 3) colours in [0, 255] of points: smooth value noise of three scales, the same for every view."""
    grid = np.random.default_rng(11).uniform(0, 1, (3, 33, 33, 33, 3))
    out = np.zeros(points.shape)
    for octave, (frequency, weight) in enumerate(((3.0, 0.5), (7.0, 0.3), (15.0, 0.2))):
        p = (points + HALF) * frequency
        base = np.floor(p).astype(int)
        t = p - base
        for corner in np.ndindex(2, 2, 2):
            index = (base + corner) % 33
            share = np.prod(np.where(corner, t, 1 - t), axis=-1, keepdims=True)
            out += 255 * weight * share * grid[octave][index[..., 0], index[..., 1], index[..., 2]]
    return out


def photograph(camera) -> np.ndarray:
    """Renders the room as seen by the camera from inside, with 2 x 2 samples per pixel."""
    total = np.zeros((camera.height, camera.width, 3))
    for dx in (-0.25, 0.25):
        for dy in (-0.25, 0.25):
            moved = type(camera)(**{**vars(camera), "cx": camera.cx - dx, "cy": camera.cy - dy})
            rays = moved.world_rays()
            with np.errstate(divide="ignore"):
                t = ((np.sign(rays) * HALF - camera.center) / rays).min(axis=-1, keepdims=True)
            total += wall_texture(camera.center + t * rays)
    return (total / 4 + 0.5).astype(np.uint8)
