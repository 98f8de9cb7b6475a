"""Pairs of views that see the same points from different directions."""

from __future__ import annotations

import numpy as np

from linprim_geo.geometry.camera import Camera

# Views to compare with: so many for every point, whose rays to it make an angle between these, in degrees.
SOURCES, LEAST_ANGLE, LARGEST_ANGLE = 4, 3.0, 30.0
# A view that shows less than this share of the points to a camera, of those that want one, is not worth its time.
LEAST_SHARE = 0.1
# Points of the scene by which views are matched with each other.
COMPARED_POINTS = 2000


def source_views(cameras: list[Camera], points: np.ndarray, most: int = SOURCES) -> list[list[int]]:
    """For every camera the indices of those to compare patches with, best first, `most` at most.

    Each is the one that sees, under an angle of LEAST_ANGLE to LARGEST_ANGLE to the camera's own rays, most of the
    (P, 3) points that the camera sees and that fewer than SOURCES of those before it do. Occlusion is left out of it.
    """
    step = -(-len(points) // COMPARED_POINTS)
    points = points[::step]
    rays = np.stack([points - camera.center for camera in cameras])
    rays /= np.maximum(np.linalg.norm(rays, axis=2, keepdims=True), 1e-12)
    seen = np.stack([visible_pixels(camera, points)[0] for camera in cameras])
    low, high = np.cos(np.radians([LARGEST_ANGLE, LEAST_ANGLE]))
    chosen = []
    for index in range(len(cameras)):
        cosine = np.einsum("vpc,pc->vp", rays, rays[index])
        shared = (seen & seen[index] & (cosine > low) & (cosine < high))[:, seen[index]]
        times = np.zeros(shared.shape[1], int)
        own: list[int] = []
        while len(own) < most:
            gain = (shared & (times < SOURCES)).sum(1)
            best = int(np.argmax(gain))
            if gain[best] <= LEAST_SHARE * len(times):
                break
            own.append(best)
            times += shared[best]
            shared[best] = False
        chosen.append(own)
    return chosen


def visible_pixels(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of (P, 3) points: (P,) bool whether they lie in the image, and of those that do (Q, 2) int64 columns and rows,
    and (Q,) z-depths."""
    pixels, depth = camera.project(points)
    with np.errstate(invalid="ignore"):
        inside = (depth > 0) & (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)
    return inside, pixels[inside].astype(np.int64), depth[inside]
