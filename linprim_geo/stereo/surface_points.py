"""Surfaces by stereo of small copies of the photographs: dense enough to start a training from, and to hold it to
them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from linprim_geo.capture.small_copy import SmallCopy
from linprim_geo.capture.types import PointCloud, View
from linprim_geo.kernels.stereo_ops import support
from linprim_geo.stereo.confidence import RIGHT
from linprim_geo.stereo.depth_maps import FOREGROUND, depth_maps, inverse_planes
from linprim_geo.stereo.planes.skies import shows_sky

# Photographs are averaged down until their longer side has no more pixels, and no more of them are taken: a training
# starts with some ten thousand primitives, and a view of this size has 30,000 pixels.
LONGER_SIDE, MOST_VIEWS = 200, 100
# A point is taken if at least this share of the pixels on its side of the photograph's edges are known and go on with
# its surface (`support`). Beside a thing, where windows of stereo hold its depth for the wall's behind it, fewer do.
LEAST_SUPPORT = 1 / 2


def small_copies(views: Sequence[View]) -> list[SmallCopy]:
    """Of at most MOST_VIEWS views, evenly over their order, with at most LONGER_SIDE pixels each way."""
    chosen = np.unique(np.linspace(0, len(views) - 1, min(MOST_VIEWS, len(views))).round().astype(int))
    return [SmallCopy.within(views[k], LONGER_SIDE) for k in chosen]


@dataclass(frozen=True)
class SurfaceMap:
    """Of a small copy: (3, H, W) float32 `planes`, the inverse depth in the scene's unit and its slopes per pixel, 0
    where no surface is known, (H, W, 3) uint8 `rgb`, and whether it `shows_sky`, if that was asked."""

    view: SmallCopy
    planes: np.ndarray
    rgb: np.ndarray
    shows_sky: bool

    @property
    def known(self) -> np.ndarray:
        """(H, W) bool."""
        return self.planes[0] > 0


def surface_maps(
    views: Sequence[SmallCopy], points: np.ndarray, seed: int, *, skies: bool = False, quiet: bool = True
) -> list[SurfaceMap]:
    """Of every view the surfaces that stereo finds, other views confirm and pixels around continue; of masked
    photographs those of the foreground.

    Args:
        points: (P, 3) of the scene, as for `depth_maps`.
        skies: whether photographs that show one are looked for.

    Raises:
        LinprimError: as `depth_maps`.
    """
    maps = []
    found_maps = depth_maps(views, points, fit=False, seed=seed, quiet=quiet)
    shown = shows_sky(found_maps) if skies else [False] * len(found_maps)
    for view, found, sky in zip(views, found_maps, shown, strict=True):
        photo, camera, known = view.load(), found.camera, found.is_confirmed()
        planes = inverse_planes(camera, found.depth, found.normal @ camera.rotation.T)
        known &= support(found.grey, np.where(known, planes, np.float32(0)), RIGHT) >= LEAST_SUPPORT
        if photo.alpha is not None:
            known &= photo.alpha >= FOREGROUND
        maps.append(SurfaceMap(view, np.where(known, planes, np.float32(0)), photo.rgb, sky))
    return maps


def surface_points(maps: Sequence[SurfaceMap], count: int, seed: int) -> PointCloud:
    """`count` points, or fewer, evenly drawn from all that are known."""
    cameras = [found.view.camera for found in maps]
    xyz = [
        camera.world_rays()[found.known] / found.planes[0][found.known].astype(np.float64)[:, None] + camera.center
        for camera, found in zip(cameras, maps, strict=True)
    ]
    every = np.concatenate(xyz)
    rng = np.random.default_rng([seed, 12])
    keep = np.sort(rng.choice(len(every), min(count, len(every)), replace=False))
    return PointCloud(every[keep], np.concatenate([found.rgb[found.known] for found in maps])[keep])
