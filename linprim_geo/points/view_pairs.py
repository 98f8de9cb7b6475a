"""Select, for each view, source views that see the same points from other directions, for stereo."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import repeat

import numpy as np

from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels import surface_ops

# Each point should be seen by SOURCES source views, with an angle between the two rays from LEAST_ANGLE to
# LARGEST_ANGLE degrees.
SOURCES, LEAST_ANGLE, LARGEST_ANGLE = 4, 3.0, 30.0
# A depth needs CONFIRMING other views to confirm it, because two views may be wrong together. Points with fewer source
# views in this range of angles are also compared under larger ones, up to WIDEST_ANGLE degrees: in captures with few
# photographs there are no others. A surface that faces both views equally is tilted by half the angle to each of them.
CONFIRMING, WIDEST_ANGLE = 2, 60.0
# A source view is not worth its time if it adds less than this share of a camera's points.
LEAST_SHARE = 0.03
# A point is occluded in a view if it is deeper than the view's depth map by more than this share: three times the error
# allowed for a correct depth.
HIDDEN_SHARE = 0.03
# Largest number of scene points used to select source views.
COMPARED_POINTS = 2000


def source_views(
    cameras: Sequence[Camera],
    points: np.ndarray,
    most: int = SOURCES,
    depths: Iterable[np.ndarray] | None = None,
    widest: float = WIDEST_ANGLE,
) -> list[list[int]]:
    """Return, for each camera, the indices of at most `most` source views, best first.

    Source views are chosen greedily. First, each added view is the one that sees most of the camera's (P, 3) points,
    under angles of LEAST_ANGLE to LARGEST_ANGLE to the camera's own rays, that fewer than SOURCES chosen views see;
    then, with angles up to `widest` degrees, most of those that fewer than CONFIRMING see. The (H, W) `depths` of the
    views determine which points are occluded; without them none are.
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
    """Return, for each view, the indices of the `most` other views with the nearest camera centres, nearest first."""
    centers = np.array([camera.center for camera in cameras])
    result = []
    for number, center in enumerate(centers):
        order = np.argsort(np.linalg.norm(centers - center, axis=1), kind="stable")
        result.append([int(other) for other in order if other != number][:most])
    return result


def _seen(camera: Camera, depth: np.ndarray | None, points: np.ndarray) -> np.ndarray:
    """Return (P,) bool: which of (P, 3) points lie in the image and not behind its (H, W) depths (0 = none)."""
    inside, pixels, along = visible_pixels(camera, points)
    if depth is not None:
        nearest = depth[pixels[:, 1], pixels[:, 0]]
        inside[inside] = (along <= (1 + HIDDEN_SHARE) * nearest) | ~(nearest > 0)
    return inside


def visible_pixels(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which of (P, 3) points lie in the image, (P,) bool, and for those the (Q, 2) int64 columns and rows and
    the (Q,) z-depths."""
    inside, pixels, depth = visible_places(camera, points)
    return inside, pixels.astype(np.int64), depth


def visible_places(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the same as `visible_pixels`, with exact (Q, 2) image positions instead of integer pixels."""
    pose, lens = camera.pinhole()
    points = np.ascontiguousarray(points, np.float64)
    return surface_ops.visible_points(pose, lens, camera.width, camera.height, points)
