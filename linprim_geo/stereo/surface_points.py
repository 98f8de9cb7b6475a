"""Points on surfaces, by stereo of small copies of the photographs: dense enough to start a training from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from linprim_geo.capture.small_copy import SmallCopy
from linprim_geo.capture.types import PointCloud, View
from linprim_geo.stereo.depth_maps import FOREGROUND, DepthMap, depth_maps, inverse_planes
from linprim_geo.stereo.evidence import support

# Photographs are averaged down until their longer side has no more pixels, and no more of them are taken: a training
# starts with some ten thousand primitives, and a view of this size has 30,000 pixels.
LONGER_SIDE, MOST_VIEWS = 200, 100
# A point belongs to a surface that at least this share of the places around it continue (`support`): at the corner of a
# flat face three of eight do. What lies beyond edges of surfaces, where windows of stereo hold them, has fewer.
LEAST_SUPPORT = 3 / 8


def small_copies(views: Sequence[View]) -> list[SmallCopy]:
    """Of at most MOST_VIEWS views, evenly over their order, with at most LONGER_SIDE pixels each way."""
    chosen = np.unique(np.linspace(0, len(views) - 1, min(MOST_VIEWS, len(views))).round().astype(int))
    cameras = [views[k].camera for k in chosen]
    factors = [-(-max(camera.width, camera.height) // LONGER_SIDE) for camera in cameras]
    return [SmallCopy.of(views[k], factor) for k, factor in zip(chosen, factors, strict=True)]


def surface_points(
    views: Sequence[View], points: np.ndarray, count: int, seed: int, *, quiet: bool = True
) -> tuple[PointCloud, float]:
    """`count` points, or fewer, that stereo finds, other views confirm and pixels around continue, evenly drawn.

    Returns: the points, and the share of all pixels that have one.

    Args:
        views: posed photographs; of masked ones the foreground counts.
        points: (P, 3) of the scene, as for `depth_maps`.

    Raises:
        LinprimError: as `depth_maps`.
    """
    xyz, rgb, pixels = [], [], 0
    for view, found in zip(views, depth_maps(views, points, seed=seed, quiet=quiet), strict=True):
        photo, taken = view.load(), _on_surfaces(found)
        if photo.alpha is not None:
            taken &= photo.alpha >= FOREGROUND
        depth = found.depth[taken].astype(np.float64)
        xyz.append(view.camera.world_rays()[taken] * depth[:, None] + view.camera.center)
        rgb.append(photo.rgb[taken])
        pixels += taken.size
    every = np.concatenate(xyz)
    rng = np.random.default_rng([seed, 12])
    keep = np.sort(rng.choice(len(every), min(count, len(every)), replace=False))
    return PointCloud(every[keep], np.concatenate(rgb)[keep]), len(every) / pixels


def _on_surfaces(found: DepthMap) -> np.ndarray:
    """(H, W) bool: confirmed depths on a surface that confirmed depths around continue."""
    confirmed, camera = found.is_confirmed(), found.camera
    planes = inverse_planes(camera, found.depth, found.normal @ camera.rotation.T)
    return confirmed & (support(planes, confirmed) >= LEAST_SUPPORT)
