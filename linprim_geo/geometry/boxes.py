"""Blocks of space: boxes that share the work of training a large scene, and which pixels of a view belong to each."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.camera import Camera

# A margin is this part of the longest side of what a block holds, median over the blocks.
MARGIN = 0.2
# A point that lies behind the depth of its pixel by more than this share is hidden there.
HIDDEN = 0.1
# A camera sees a block if this share of its pixels shows it.
LEAST_SHARE = 0.005
# Pixels beyond those that show a block which belong to it, for depths are coarse, and pixels round them that a
# structural similarity looks at.
DILATION, BORDER = 2, 8
# Sides of the box that holds the bulk of some points are these quantiles.
_BULK = (0.01, 0.99)


@dataclass(frozen=True)
class Block:
    """The points x with low <= x < high per axis, both (3,); infinite where no other block lies beyond."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    def holds(self, xyz: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """(...,) bool for (..., 3) points; with `margin` those in the block grown by it on all sides."""
        return np.all((xyz >= np.asarray(self.low) - margin) & (xyz < np.asarray(self.high) + margin), axis=-1)

    def distance(self, xyz: np.ndarray) -> np.ndarray:
        """(...,) by how much the block is to grow on all sides to reach (..., 3) points."""
        return np.maximum(np.maximum(np.asarray(self.low) - xyz, xyz - np.asarray(self.high)), 0.0).max(-1)

    def is_apart(self, other: Block, margin: float) -> bool:
        """Whether the other lies farther than `margin` from this one along an axis."""
        ends = zip(self.low, self.high, other.low, other.high, strict=True)
        return any(low - margin > far or near > high + margin for low, high, near, far in ends)


def split_space(xyz: np.ndarray, work: np.ndarray, count: int) -> list[Block]:
    """`count` boxes that fill space, each with about the same part of the `work` (P,) of the points `xyz` (P, 3).

    A k-d tree: what holds the bulk of the points is cut across its longest side, in the ratio of the blocks that come
    to lie on either side.

    Raises:
        LinprimError: there are not so many places to cut at.
    """
    low, high = (-np.inf,) * 3, (np.inf,) * 3
    return _split(np.asarray(xyz, np.float64), np.asarray(work, np.float64), count, low, high)


def _split(xyz, work, count, low, high) -> list[Block]:
    if count == 1:
        return [Block(low, high)]
    first = count // 2
    for axis in np.argsort(-np.ptp(np.quantile(xyz, _BULK, axis=0), axis=0), kind="stable") if len(xyz) else ():
        order = np.argsort(xyz[:, axis], kind="stable")
        along, total = xyz[order, axis], np.cumsum(work[order])
        place = int(np.searchsorted(total, first / count * total[-1]))
        place = min(max(place, 1), len(along) - 1)
        cut = 0.5 * float(along[place - 1] + along[place])
        below = xyz[:, axis] < cut
        if below.sum() < first or (~below).sum() < count - first:
            continue  # all in one place along this axis
        inner = [*high[:axis], cut, *high[axis + 1 :]], [*low[:axis], cut, *low[axis + 1 :]]
        return [
            *_split(xyz[below], work[below], first, low, tuple(inner[0])),
            *_split(xyz[~below], work[~below], count - first, tuple(inner[1]), high),
        ]
    raise LinprimError(
        f"--blocks is too large: there are {len(xyz)} points where {count} blocks are to be, wanted fewer blocks"
    )


def margin_of(blocks: Sequence[Block], xyz: np.ndarray) -> float:
    """MARGIN of the longest side, median over the blocks, of the bulk of the points in each."""
    inside = [xyz[block.holds(xyz)] for block in blocks]
    sides = [np.ptp(np.quantile(points, _BULK, axis=0), axis=0).max() for points in inside if len(points)]
    return MARGIN * float(np.median(sides))


def smaller(camera: Camera, factor: int) -> Camera:
    """The same view with `factor` by `factor` pixels averaged into one, as `capture.load.load_scene` does."""
    k = factor
    width, height = camera.width // k, camera.height // k
    return replace(
        camera, width=width, height=height, fx=camera.fx / k, fy=camera.fy / k, cx=camera.cx / k, cy=camera.cy / k
    )


def cropped(camera: Camera, left: int, top: int, width: int, height: int) -> Camera:
    """The part of a view of so many pixels whose first one is (left, top)."""
    return replace(camera, width=width, height=height, cx=camera.cx - left, cy=camera.cy - top)


def point_work(xyz: np.ndarray, views: Iterable[tuple[Camera, np.ndarray, int]]) -> np.ndarray:
    """(P,) work of points (P, 3): the pixels of all views that see each.

    Args:
        views: camera, its z-depths (H, W), 0 where nothing is, and the pixels of its photograph. A point that lies
            farther than the depth of its pixel, by more than HIDDEN of it, is hidden.
    """
    work = np.zeros(len(xyz))
    for camera, depth, pixels in views:
        place, z = camera.project(xyz)
        inside = camera.shows(place, z)
        column, row = place[inside].astype(np.int64).T
        there = depth[row, column]
        seen = (there == 0) | (z[inside] <= (1 + HIDDEN) * there)
        work[np.flatnonzero(inside)[seen]] += pixels
    return work


def surface_points(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """(H, W, 3) points of a view at z-depths (H, W), NaN where that is 0."""
    return camera.center + camera.world_rays() * np.where(depth > 0, depth, np.nan)[..., None]


def enlarged(mask: np.ndarray, camera: Camera, factor: int) -> np.ndarray:
    """(H, W) bool of the photograph's pixels, from a mask (h, w) of a view `factor` times as small, and those round
    it."""
    from scipy.ndimage import binary_dilation

    mask = binary_dilation(mask, iterations=DILATION)
    full = np.zeros((camera.height, camera.width), dtype=bool)
    large = np.repeat(np.repeat(mask, factor, 0), factor, 1)[: camera.height, : camera.width]
    full[: large.shape[0], : large.shape[1]] = large
    return full


def window(mask: np.ndarray, camera: Camera, factor: int) -> tuple[int, int, int, int] | None:
    """(left, top, width, height) of the part of a photograph that shows a block, from a mask (h, w) of a view `factor`
    times as small; None where less than LEAST_SHARE of the pixels show it."""
    if mask.sum() < max(4, LEAST_SHARE * mask.size):
        return None
    full = enlarged(mask, camera, factor)
    rows, columns = np.flatnonzero(full.any(1)), np.flatnonzero(full.any(0))
    top, left = max(0, rows[0] - BORDER), max(0, columns[0] - BORDER)
    bottom, right = min(camera.height, rows[-1] + 1 + BORDER), min(camera.width, columns[-1] + 1 + BORDER)
    return int(left), int(top), int(right - left), int(bottom - top)
