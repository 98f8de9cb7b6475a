"""Evidence for edges along lines of the world in several photographs.

A single photograph may have an edge along a line by chance; views from different directions hardly have theirs along
the same line of the world. Candidate lines are ranked within each view, as light and noise differ between photographs,
and the ranks are combined by Fisher's method.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.stats import chi2, rankdata

from linprim_geo.geometry.camera import Camera
from linprim_geo.points.view_pairs import visible_pixels
from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.evidence import CONFIRMED_DEPTH
from linprim_geo.stereo.planes.plain_regions import LEAST_VIEWS

# Standard deviation in pixels of the blur applied before edges are searched.
BLUR = 1.5
# The fewest pixels of a line that a view has to show to count.
LEAST_PIXELS = 20
# The largest probability that a search finds an edge by chance, if views were independent; neighbours are not quite. A
# view shows an edge if at most the share SHOWN of the candidates have one as strong there.
BY_CHANCE, SHOWN = 1e-3, 0.1
# A surface nearer than an edge by more than this share of the depth hides it.
HIDING = 3 * CONFIRMED_DEPTH


class EdgeImages:
    """The change of grey across lines of the world in every view, where no `known` depth (H, W) hides them."""

    def __init__(self, maps: Sequence[DepthMap], known: Sequence[np.ndarray]):
        self.cameras, self.known = [found.camera for found in maps], known
        greys = (found.grey.astype(np.float32) for found in maps)
        self.slopes = [[gaussian_filter(grey, BLUR, order=order) for order in ((0, 1), (1, 0))] for grey in greys]

    def pixel_at(self, place: np.ndarray) -> float:
        """Return the size of a pixel at a point (3,) in the world, the median over the cameras."""
        return float(np.median([np.linalg.norm(camera.center - place) / camera.fx for camera in self.cameras]))

    def strongest(self, starts: np.ndarray, directions: np.ndarray, along: np.ndarray) -> int | None:
        """Return the index of the line with the strongest edge, or None. Lines are given as for `strengths`; only views
        that show all of them count, each with equal weight."""
        strength = self.strengths(starts, directions, along, 1)[:, :, 0]
        most = strength.max(1, keepdims=True)  # NaN where a line is not shown
        every = most[:, 0] > 0
        return int((strength[every] / most[every]).sum(0).argmax()) if every.any() else None

    def shares(
        self, starts: np.ndarray, directions: np.ndarray, along: np.ndarray, parts: int, least: float = 0.0
    ) -> np.ndarray:
        """Return (V, N, parts): the rank of each line in each view, as the share of the lines shown there whose edge is
        at least as strong; NaN where the view does not show it. The arguments are those of `strengths`."""
        result = self.strengths(starts, directions, along, parts, least)
        for view, part in np.ndindex(len(result), parts):
            strength = result[view, :, part]
            shown = np.isfinite(strength)
            strength[shown] = rankdata(-strength[shown], method="max") / max(np.count_nonzero(shown), 1)
        return result

    def strengths(
        self, starts: np.ndarray, directions: np.ndarray, along: np.ndarray, parts: int, least: float = 0.0
    ) -> np.ndarray:
        """Return (V, N, parts): by how much grey changes per pixel across lines of the world; NaN where a view shows
        fewer than LEAST_PIXELS of a line, or less than the share `least` of the line of which it shows most.

        It is the median along a line: lines in front of a wall cross the end of the floor, which is usually the
        stronger edge.

        Args:
            starts: (N, 3).
            directions: (N or 1, 3).
            along: (parts * S,) positions of samples, in units of `directions`.
            parts: lines are evaluated up to the end of each of so many parts of `along`.
        """
        result = np.full((len(self.cameras), len(starts), parts), np.nan)
        for strength, changes in zip(result, self.changes(starts, directions, along), strict=True):
            if changes is None:
                continue
            slope, length = changes
            slope, length = slope.reshape(len(starts), parts, -1), length.reshape(len(starts), parts, -1).sum(2)
            shown = length.cumsum(1)
            enough = shown >= np.maximum(LEAST_PIXELS, least * shown.max(0))
            for part in range(parts):
                if part and not length[:, part].any():
                    strength[:, part] = strength[:, part - 1]
                else:
                    rows = enough[:, part]
                    own = slope[rows, : part + 1].reshape(-1, (part + 1) * slope.shape[2])
                    strength[rows, part] = np.abs(_medians(own))
        return result

    def changes(
        self, starts: np.ndarray, directions: np.ndarray, along: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray] | None]:
        """Yield for each view (N, S) float32, by how much grey changes per pixel across lines as those of `strengths`,
        NaN where the view does not show them, and (N, S) the length of each sample in pixels. None for a view that
        shows nothing."""
        apart, places = along[1] - along[0], starts[:, None] + along[:, None] * directions[:, None]
        box = _box_of(places)
        for camera, known, slopes in zip(self.cameras, self.known, self.slopes, strict=True):
            if not _may_show(camera, box):
                yield None
                continue
            shown, pixels, depth = visible_pixels(camera, places.reshape(-1, 3))
            column, row = pixels.T
            clear = ~(known[row, column] < (1 - HIDING) * depth)
            # The step of a line per sample in pixels, and the change of grey across it.
            local = places.reshape(-1, 3)[shown] @ camera.rotation.T + camera.world_to_camera[:3, 3]
            steps = np.broadcast_to(directions[:, None] * apart, places.shape).reshape(-1, 3)[shown] @ camera.rotation.T
            right = camera.fx * (steps[:, 0] - local[:, 0] / depth * steps[:, 2]) / depth
            down = camera.fy * (steps[:, 1] - local[:, 1] / depth * steps[:, 2]) / depth
            change, length = np.zeros((2, *places.shape[:2])).reshape(2, -1)
            change[shown] = clear * (slopes[1][row, column] * right - slopes[0][row, column] * down)
            length[shown] = clear * np.hypot(right, down)
            slope = np.divide(change, length, out=np.full(change.shape, np.nan), where=length > 0).astype(np.float32)
            yield slope.reshape(places.shape[:2]), length.reshape(places.shape[:2])


def _box_of(places: np.ndarray) -> np.ndarray:
    """Return the (8, 3) corners of the bounding box of (..., 3) points."""
    every = places.reshape(-1, 3)
    return np.array(list(product(*zip(every.min(0), every.max(0), strict=True))))


def _may_show(camera: Camera, box: np.ndarray) -> bool:
    """Return whether an image may show a box: not all of its (8, 3) corners are beyond one side."""
    x, y, z = camera.rotation @ box.T + camera.world_to_camera[:3, 3:]
    left, top = camera.fx * x + camera.cx * z, camera.fy * y + camera.cy * z
    beyond = (z <= 0, left < 0, left > camera.width * z, top < 0, top > camera.height * z)
    return not any(side.all() for side in beyond)


def _medians(values: np.ndarray) -> np.ndarray:
    """Return the (N,) medians of N rows without NaN, each with at least one number. np.nanmedian takes ten times as
    long."""
    ordered, count = np.sort(values, axis=1), np.isfinite(values).sum(1)
    rows = np.arange(len(values))
    return (ordered[rows, (count - 1) // 2] + ordered[rows, count // 2]) / 2


def by_chance(shares: np.ndarray) -> np.ndarray:
    """Return the (N, K) natural logarithm of the probability that (V, N, K) ranks are as small by chance, by Fisher's
    method; 0 where fewer than LEAST_VIEWS of them are not NaN."""
    views = np.isfinite(shares).sum(0)
    surprise = -2 * np.log(np.where(np.isfinite(shares), shares, 1)).sum(0)
    return np.where(views >= LEAST_VIEWS, chi2.logsf(surprise, 2 * np.maximum(views, 1)), 0)
