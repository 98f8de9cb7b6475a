"""Reject surfaces on which photographs show different colours.

Between balusters stereo matches only their edges, so that a plane through these closes the gaps. What shows in the gaps
depends on the position of the camera: a wall, a door, the stairs. A point on a true surface has one colour in all
photographs, apart from exposure.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.edges import rgb_of
from linprim_geo.stereo.evidence import CONFIRMED_DEPTH
from linprim_geo.stereo.planes.plain_regions import LEAST_POINTS, LEAST_VIEWS, rays_of, to_world
from linprim_geo.stereo.planes.seen_through import MARGIN

# Points of a view by which its exposure is compared with other views, and the fewest that another view has to know.
TRIED_POINTS, COMMON_POINTS = 1000, 2 * LEAST_POINTS
# A point has another colour if red, green or blue differs by more than this share after correction of exposure. A
# surface has other colours in a view if most of its points do. Gloss changes dark objects by less (DECISIONS 147).
OTHER = 0.15
# Values from CLIPPED of 255 on count as clipped. DARK is added to all values, as dark pixels are glossy and noisy.
CLIPPED, DARK = 245.0, 32.0
# The most points of a surface that are compared, and the fewest that another view has to see.
COMPARED, FEWEST = 100, 10
# Views at grazing angles are not compared: the least cosine of the viewing direction to the normal.
STEEPEST = 0.25


class ShownColours:
    """The colours of all views. The `known` depths (H, W) of each, NaN elsewhere, tell which points are hidden, and the
    exposure of each view relative to others."""

    def __init__(self, maps: Sequence[DepthMap], known: Sequence[np.ndarray], seed: int = 0):
        self.size = np.array([[found.camera.width // 2, found.camera.height // 2] for found in maps])
        self.start = np.append(0, np.cumsum(self.size.prod(1)))
        self.lens = np.array([[found.camera.fx, found.camera.fy, found.camera.cx, found.camera.cy] for found in maps])
        self.centers = np.stack([found.camera.center for found in maps])
        self.pose = np.stack([found.camera.world_to_camera[:3] for found in maps])
        self.logs = np.concatenate([_log_colours(found).reshape(-1, 3) for found in maps])
        halves = [_nearest_of_four(depth) for depth in known]
        self.nearest = np.concatenate([half.ravel() for half in halves])
        self.gain = np.full((len(maps), len(maps), 3), np.nan, np.float32)
        rng = np.random.default_rng(seed)
        for view, (found, depth) in enumerate(zip(maps, known, strict=True)):
            row, column = np.nonzero(np.isfinite(depth))
            some = rng.permutation(len(row))[:TRIED_POINTS]
            row, column = row[some], column[some]
            rays = rays_of(found.camera, row, column)
            points = to_world(found.camera, rays * depth[row, column, None])
            pixel, along, inside = self._pixels(points)
            ratio = self.logs[pixel] - self.logs[pixel[view]]
            both = inside & (np.abs(self.nearest[pixel] / along - 1) < CONFIRMED_DEPTH) & np.isfinite(ratio).all(-1)
            for other in np.flatnonzero(both.sum(1) >= COMMON_POINTS):
                self.gain[view, other] = np.median(ratio[other, both[other]], axis=0)

    def differ(self, view: int, points: np.ndarray, normal: np.ndarray) -> bool:
        """Return whether (P, 3) points of a plane with this normal, shown by a view, have other colours in most views
        that see the same side of it. False if fewer than LEAST_VIEWS see it."""
        if not len(points):
            return False
        points = points[:: -(-len(points) // COMPARED)]
        towards = self.centers - points.mean(0)
        slope = towards @ normal / np.maximum(np.linalg.norm(towards, axis=1), 1e-12)
        facing = slope * np.sign(slope[view]) > STEEPEST
        pixel, along, inside = self._pixels(points)
        ratio = np.abs(self.logs[pixel] - self.logs[pixel[view]] - self.gain[view][:, None]).max(-1)
        seen = inside & (self.nearest[pixel] >= (1 - MARGIN) * along) & np.isfinite(ratio)
        seen &= facing[:, None]
        seen[view] = False
        count, others = seen.sum(1), (seen & (ratio > OTHER)).sum(1)
        asked = count >= FEWEST
        return bool(asked.sum() >= LEAST_VIEWS and np.mean(2 * others[asked] > count[asked]) > 0.5)

    def _pixels(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Project (P, 3) points to all views. Return (V, P) indices of blocks of 2 by 2 pixels, depths, and whether the
        point is in the image."""
        local = np.einsum("vij,pj->vpi", self.pose[:, :, :3], points) + self.pose[:, None, :, 3]
        along = local[..., 2]
        before = along > 0
        place = local[..., :2] / np.where(before, along, 1)[..., None] * self.lens[:, None, :2] + self.lens[:, None, 2:]
        block = np.floor(place / 2)
        inside = before & (block >= 0).all(-1) & (block < self.size[:, None]).all(-1)
        block = np.where(inside[..., None], block, 0).astype(np.int64)
        return self.start[:-1, None] + block[..., 1] * self.size[:, :1] + block[..., 0], along, inside


def _log_colours(found: DepthMap) -> np.ndarray:
    """Return the (H // 2, W // 2, 3) float32 logarithms of red, green and blue, DARK added, in means of 2 by 2 pixels;
    NaN where one is clipped."""
    height, width = (size // 2 for size in found.grey.shape)
    grey = found.grey[: 2 * height, : 2 * width].reshape(height, 2, width, 2).mean((1, 3), dtype=np.float32)
    values = np.repeat(grey[..., None], 3, axis=2) if found.colours is None else rgb_of(grey, found.colours)
    return np.log(np.where((values < CLIPPED).all(-1, keepdims=True), np.maximum(values, 0) + DARK, np.nan))


def _nearest_of_four(depth: np.ndarray) -> np.ndarray:
    """Return the (H // 2, W // 2) nearest depth of each 2 by 2 pixels, infinite where none is known."""
    height, width = (size // 2 for size in depth.shape)
    known = np.where(np.isfinite(depth), depth, np.float32(np.inf))
    return known[: 2 * height, : 2 * width].reshape(height, 2, width, 2).min((1, 3))
