"""Pairs of views that see the same points from different directions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import repeat

import numpy as np

from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels import surface_ops

# Views to compare with: so many for every point, whose rays to it make an angle between these, in degrees.
SOURCES, LEAST_ANGLE, LARGEST_ANGLE = 4, 3.0, 30.0
# So many other views confirm a depth, as two may be wrong about each other. Points that fewer see under such angles are
# compared under larger ones, up to this, in degrees: of few photographs there are no others. A surface that both views
# look onto evenly is turned by half of it.
CONFIRMING, WIDEST_ANGLE = 2, 60.0
# A view that shows less than this share of the points to a camera, of those that want one, is not worth its time.
LEAST_SHARE = 0.03
# A point that is farther than the depth map of a view by more than this share of the depth is hidden from it: three
# times what a depth may be off by that counts as right.
HIDDEN_SHARE = 0.03
# Points of the scene by which views are matched with each other.
COMPARED_POINTS = 2000


def source_views(
    cameras: Sequence[Camera],
    points: np.ndarray,
    most: int = SOURCES,
    depths: Iterable[np.ndarray] | None = None,
    widest: float = WIDEST_ANGLE,
) -> list[list[int]]:
    """For every camera the indices of those to compare patches with, best first, `most` at most.

    Each is the one that sees, under an angle of LEAST_ANGLE to LARGEST_ANGLE to the camera's own rays, most of the
    (P, 3) points that the camera sees and that fewer than SOURCES of those before it do; then, under an angle of up to
    `widest` degrees, most of those that fewer than CONFIRMING do. Surfaces with the (H, W) `depths` of the views hide
    points; without them nothing does.
    """
    step = -(-len(points) // COMPARED_POINTS)
    points = points[::step]
    rays = np.stack([points - camera.center for camera in cameras])
    rays /= np.maximum(np.linalg.norm(rays, axis=2, keepdims=True), 1e-12)
    nearest = repeat(None, len(cameras)) if depths is None else depths
    seen = np.stack([_seen(*each, points) for each in zip(cameras, nearest, strict=True)])
    widest, largest, least = np.cos(np.radians([widest, LARGEST_ANGLE, LEAST_ANGLE]))
    chosen = []
    for index in range(len(cameras)):
        cosine = np.einsum("vpc,pc->vp", rays, rays[index])
        shared = (seen & seen[index] & (cosine > widest) & (cosine < least))[:, seen[index]]
        narrow = shared & (cosine > largest)[:, seen[index]]
        own: list[int] = []
        for among, wanted in ((narrow, SOURCES), (shared, CONFIRMING)):
            while len(own) < most:
                gain = (among & (among[own].sum(0) < wanted)).sum(1)
                gain[own] = 0
                best = int(np.argmax(gain))
                if gain[best] <= LEAST_SHARE * shared.shape[1]:
                    break
                own.append(best)
        chosen.append(own)
    return chosen


def nearest_views(cameras: Sequence[Camera], most: int) -> list[list[int]]:
    """Of every view the numbers of the `most` other ones whose cameras are nearest to its own, nearest first."""
    centers = np.array([camera.center for camera in cameras])
    result = []
    for number, center in enumerate(centers):
        order = np.argsort(np.linalg.norm(centers - center, axis=1), kind="stable")
        result.append([int(other) for other in order if other != number][:most])
    return result


def _seen(camera: Camera, depth: np.ndarray | None, points: np.ndarray) -> np.ndarray:
    """(P,) bool, which of (P, 3) points lie in the image and not behind its (H, W) depths, 0 where there is none."""
    inside, pixels, along = visible_pixels(camera, points)
    if depth is not None:
        nearest = depth[pixels[:, 1], pixels[:, 0]]
        inside[inside] = (along <= (1 + HIDDEN_SHARE) * nearest) | ~(nearest > 0)
    return inside


def visible_pixels(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of (P, 3) points: (P,) bool whether they lie in the image, and of those that do (Q, 2) int64 columns and rows,
    and (Q,) z-depths."""
    inside, pixels, depth = visible_places(camera, points)
    return inside, pixels.astype(np.int64), depth


def visible_places(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `visible_pixels`, with (Q, 2) positions in the image in place of pixels."""
    pose, lens = camera.pinhole()
    points = np.ascontiguousarray(points, np.float64)
    return surface_ops.visible_points(pose, lens, camera.width, camera.height, points)
