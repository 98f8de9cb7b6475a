"""Surfaces by stereo of small copies of the photographs, to initialise and to supervise training."""

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

# The longest side in pixels to which photographs are averaged down, and the most photographs used: training starts with
# some ten thousand primitives, and a view of this size has 30,000 pixels.
LONGER_SIDE, MOST_VIEWS = 200, 100
# A point is used if at least this share of the pixels on its side of the photograph's edges is known and continues its
# surface (`support`). Beside an object, where windows of stereo extend its depth over the wall behind, fewer do.
LEAST_SUPPORT = 1 / 2


def small_copies(views: Sequence[View]) -> list[SmallCopy]:
    """Return small copies of at most MOST_VIEWS views, evenly chosen in their order, with at most LONGER_SIDE pixels a
    side."""
    chosen = np.unique(np.linspace(0, len(views) - 1, min(MOST_VIEWS, len(views))).round().astype(int))
    return [SmallCopy.within(views[k], LONGER_SIDE) for k in chosen]


@dataclass(frozen=True)
class SurfaceMap:
    """The surfaces of a small copy: `planes` (3, H, W) float32, inverse depth in the scene's unit and its slopes per
    pixel, 0 where no surface is known; `rgb` (H, W, 3) uint8; and whether it `shows_sky`, false unless that was
    requested."""

    view: SmallCopy
    planes: np.ndarray
    rgb: np.ndarray
    shows_sky: bool

    @property
    def known(self) -> np.ndarray:
        """(H, W) bool: pixels with a surface."""
        return self.planes[0] > 0


def surface_maps(
    views: Sequence[SmallCopy], points: np.ndarray, seed: int, *, skies: bool = False, quiet: bool = True
) -> list[SurfaceMap]:
    """Return for every view the surfaces that stereo finds, other views confirm and pixels around support; of masked
    photographs only those of the foreground.

    Args:
        points: (P, 3) of the scene, as for `depth_maps`.
        skies: whether photographs that show a sky are detected.

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
    """Return at most `count` points, drawn uniformly from all known pixels."""
    cameras = [found.view.camera for found in maps]
    xyz = [
        camera.world_rays()[found.known] / found.planes[0][found.known].astype(np.float64)[:, None] + camera.center
        for camera, found in zip(cameras, maps, strict=True)
    ]
    every = np.concatenate(xyz)
    rng = np.random.default_rng([seed, 12])
    keep = np.sort(rng.choice(len(every), min(count, len(every)), replace=False))
    return PointCloud(every[keep], np.concatenate([found.rgb[found.known] for found in maps])[keep])
