"""Blocks: axis-aligned boxes that divide the work of training a large scene, and which pixels of a view show each."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.camera import Camera

# Margin of blocks, as a share of the longest side of a block's content (median over the blocks).
MARGIN = 0.2
# A point is occluded in a view if it lies behind the depth of its pixel by more than this share.
HIDDEN = 0.1
# A camera sees a block if at least this share of its pixels shows it.
LEAST_SHARE = 0.005
# DILATION: pixels of the coarse depth map by which the region that shows a block is dilated, because depths are coarse.
# BORDER: pixels added around the crop for the window of SSIM.
DILATION, BORDER = 2, 8
# Quantiles between which the bulk of a set of points lies, per axis.
_BULK = (0.01, 0.99)


@dataclass(frozen=True)
class Block:
    """The points x with low <= x < high per axis, both (3,); infinite where no other block lies beyond."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    def holds(self, xyz: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Return (...,) bool: which of (..., 3) points lie in the block, grown by `margin` on all sides."""
        return np.all((xyz >= np.asarray(self.low) - margin) & (xyz < np.asarray(self.high) + margin), axis=-1)

    def distance(self, xyz: np.ndarray) -> np.ndarray:
        """Return (...,) by how much the block must grow on all sides to contain each of (..., 3) points."""
        return np.maximum(np.maximum(np.asarray(self.low) - xyz, xyz - np.asarray(self.high)), 0.0).max(-1)

    def is_apart(self, other: Block, margin: float) -> bool:
        """Return whether the other block is farther away than `margin` along an axis."""
        ends = zip(self.low, self.high, other.low, other.high, strict=True)
        return any(low - margin > far or near > high + margin for low, high, near, far in ends)


def split_space(xyz: np.ndarray, work: np.ndarray, count: int) -> list[Block]:
    """Split space into `count` boxes, each with about the same share of the `work` (P,) of the points `xyz` (P, 3).

    A k-d tree: the bulk of the points is cut across its longest side, in proportion to the number of blocks on either
    side.

    Raises:
        LinprimError: there are not enough places to cut at.
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
            continue  # all points have the same coordinate along this axis
        inner = [*high[:axis], cut, *high[axis + 1 :]], [*low[:axis], cut, *low[axis + 1 :]]
        return [
            *_split(xyz[below], work[below], first, low, tuple(inner[0])),
            *_split(xyz[~below], work[~below], count - first, tuple(inner[1]), high),
        ]
    raise LinprimError(
        f"--blocks is too large: there are {len(xyz)} points where {count} blocks are to be, wanted fewer blocks"
    )


def margin_of(blocks: Sequence[Block], xyz: np.ndarray) -> float:
    """Return MARGIN times the longest side of the bulk of the points in a block, median over the blocks."""
    inside = [xyz[block.holds(xyz)] for block in blocks]
    sides = [np.ptp(np.quantile(points, _BULK, axis=0), axis=0).max() for points in inside if len(points)]
    return MARGIN * float(np.median(sides))


def smaller(camera: Camera, factor: int) -> Camera:
    """Return the same view with `factor` by `factor` pixels averaged into one, as in `capture.load.load_scene`."""
    k = factor
    width, height = camera.width // k, camera.height // k
    return replace(
        camera, width=width, height=height, fx=camera.fx / k, fy=camera.fy / k, cx=camera.cx / k, cy=camera.cy / k
    )


def cropped(camera: Camera, left: int, top: int, width: int, height: int) -> Camera:
    """Return the camera of a crop of `width` by `height` pixels whose first pixel is (left, top)."""
    return replace(camera, width=width, height=height, cx=camera.cx - left, cy=camera.cy - top)


def point_work(xyz: np.ndarray, views: Iterable[tuple[Camera, np.ndarray, int]]) -> np.ndarray:
    """Return (P,) the work of points (P, 3): the summed pixel counts of all views that see each point.

    Args:
        views: camera, its z-depths (H, W), 0 where there is no surface, and the number of pixels of its photograph. A
            point deeper than its pixel by more than the share HIDDEN is occluded.
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
    """Return (H, W, 3) points of a view at z-depths (H, W), NaN where the depth is 0."""
    return camera.center + camera.world_rays() * np.where(depth > 0, depth, np.nan)[..., None]


def enlarged(mask: np.ndarray, camera: Camera, factor: int) -> np.ndarray:
    """Return an (H, W) bool mask in the photograph's pixels from a mask (h, w) of a view `factor` times as small,
    dilated by DILATION."""
    from scipy.ndimage import binary_dilation

    mask = binary_dilation(mask, iterations=DILATION)
    full = np.zeros((camera.height, camera.width), dtype=bool)
    large = np.repeat(np.repeat(mask, factor, 0), factor, 1)[: camera.height, : camera.width]
    full[: large.shape[0], : large.shape[1]] = large
    return full


def window(mask: np.ndarray, camera: Camera, factor: int) -> tuple[int, int, int, int] | None:
    """Return (left, top, width, height) of the crop of a photograph that shows a block, from a mask (h, w) of a view
    `factor` times as small; None if less than LEAST_SHARE of the pixels show it."""
    if mask.sum() < max(4, LEAST_SHARE * mask.size):
        return None
    full = enlarged(mask, camera, factor)
    rows, columns = np.flatnonzero(full.any(1)), np.flatnonzero(full.any(0))
    top, left = max(0, rows[0] - BORDER), max(0, columns[0] - BORDER)
    bottom, right = min(camera.height, rows[-1] + 1 + BORDER), min(camera.width, columns[-1] + 1 + BORDER)
    return int(left), int(top), int(right - left), int(bottom - top)
