"""Detect false depths in the air, through which other views see surfaces behind.

Beside the outline of an object in front of a plain wall, only the outline can be matched. Stereo gives its depth to the
wall up to ten pixels beside it, and views from nearby confirm that. Views from elsewhere see through this false
surface.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from scipy.ndimage import minimum_filter

from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels import surface_ops
from linprim_geo.stereo.planes.plain_regions import BEHIND, TOLERANCE, rays_of, to_world

# A view sees through a point if its known depth is behind the point by more than this share of the depth.
MARGIN = BEHIND * TOLERANCE
# A point is in the air if at least SEEING views see through it, and more than the share SEEING_SHARE of the views that
# know a surface at it: a single depth may be wrong.
SEEING, SEEING_SHARE = 2, 0.25
# The side in pixels of the square around a pixel of which the nearest depth counts: beside an outline, a point may be
# on either side.
AROUND = 3


class FreeSpaceTest:
    """The depths that views know: (H, W) `depths` of each of the `cameras`, NaN where unknown."""

    def __init__(self, cameras: Sequence[Camera], depths: Iterable[np.ndarray]):
        self.cameras = cameras
        self.views = [
            (*camera.pinhole(), _nearest_around(depth)) for camera, depth in zip(cameras, depths, strict=True)
        ]

    def see_through(self, points: np.ndarray) -> np.ndarray:
        """Return (P,) bool: which of (P, 3) points of the world are in the air."""
        looking, knowing = surface_ops.count_looking_views(self.views, np.ascontiguousarray(points), MARGIN)
        through = looking - knowing
        return (through >= SEEING) & (through > SEEING_SHARE * knowing)

    def know(self, points: np.ndarray) -> np.ndarray:
        """Return (P,) bool: at which of (P, 3) points of the world more views know a surface than see through."""
        looking, knowing = surface_ops.count_looking_views(self.views, np.ascontiguousarray(points), MARGIN)
        return 2 * knowing > looking

    def clear(self, depths: Sequence[np.ndarray], asked: Sequence[np.ndarray]) -> None:
        """Set (H, W) `depths` of every view to NaN in place where they are in the air, at the `asked` (H, W) pixels."""
        for camera, depth, where in zip(self.cameras, depths, asked, strict=True):
            row, column = np.nonzero(where & np.isfinite(depth))
            air = self.see_through(to_world(camera, rays_of(camera, row, column) * depth[row, column, None]))
            depth[row[air], column[air]] = np.nan


def _nearest_around(depth: np.ndarray) -> np.ndarray:
    """Return the (H, W) float32 nearest depth around each pixel that has one; 0 elsewhere, with which a view sees
    through nothing."""
    known = np.isfinite(depth)
    return np.where(known, minimum_filter(np.where(known, depth, np.inf), AROUND), 0).astype(np.float32)
