"""Depths in the air: other photographs see through them.

Beside the outline of a thing before a plain wall nothing but the outline can be matched. Stereo gives its depth to the
wall beside it, up to ten pixels wide, and photographs from about the same place confirm that. It is a flap in the air:
photographs from elsewhere see through it what is behind.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from scipy.ndimage import minimum_filter

from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels import surface_ops
from linprim_geo.stereo.planes.plain_regions import BEHIND, TOLERANCE, rays_of, to_world

# What a view knows is behind a point, and not at it, from this share of the depth on.
MARGIN = BEHIND * TOLERANCE
# A point is in the air if at least so many views see through it, and more than this share of those that know a surface
# at it: a single depth may be wrong.
SEEING, SEEING_SHARE = 2, 0.25
# The nearest depth of the square of this side around a pixel counts: a point beside an outline may be of either side.
AROUND = 3


class KnownDepths:
    """What views know: (H, W) `depths` of each of the `cameras`, NaN where they know nothing."""

    def __init__(self, cameras: Sequence[Camera], depths: Iterable[np.ndarray]):
        self.cameras = cameras
        self.views = [
            (*camera.pinhole(), _nearest_around(depth)) for camera, depth in zip(cameras, depths, strict=True)
        ]

    def see_through(self, points: np.ndarray) -> np.ndarray:
        """(P,) bool which of (P, 3) points of the world are in the air."""
        looking, knowing = surface_ops.count_looking_views(self.views, np.ascontiguousarray(points), MARGIN)
        through = looking - knowing
        return (through >= SEEING) & (through > SEEING_SHARE * knowing)

    def know(self, points: np.ndarray) -> np.ndarray:
        """(P,) bool which of (P, 3) points of the world more views know a surface at than see through."""
        looking, knowing = surface_ops.count_looking_views(self.views, np.ascontiguousarray(points), MARGIN)
        return 2 * knowing > looking

    def clear(self, depths: Sequence[np.ndarray], asked: Sequence[np.ndarray]) -> None:
        """Makes (H, W) `depths` of every view, NaN where there are none, NaN where they are in the air, too, of the
        pixels that are `asked` (H, W) for."""
        for camera, depth, where in zip(self.cameras, depths, asked, strict=True):
            row, column = np.nonzero(where & np.isfinite(depth))
            air = self.see_through(to_world(camera, rays_of(camera, row, column) * depth[row, column, None]))
            depth[row[air], column[air]] = np.nan


def _nearest_around(depth: np.ndarray) -> np.ndarray:
    """(H, W) float32, the nearest depth around each pixel that has one; 0 elsewhere, as who knows nothing sees through
    nothing."""
    known = np.isfinite(depth)
    return np.where(known, minimum_filter(np.where(known, depth, np.inf), AROUND), 0).astype(np.float32)
