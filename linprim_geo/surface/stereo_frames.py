"""Depth maps for fusing out of two sources: what stereo finds and its neighbours confirm, and what the primitives
render everywhere else, with the weight that its deviation from the former deserves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from linprim_geo.capture.types import View
from linprim_geo.stereo.depth_maps import DepthMap, depth_maps
from linprim_geo.surface.tsdf_field import DepthFrame

# A depth counts as confirmed if so many neighbours confirm it, or all but one of fewer.
NEIGHBOURS = 3
# Points of the rendered surface by which stereo finds pairs of views.
POINTS = 20_000
# The standard deviation of a normal distribution over the median of its magnitudes.
NORMAL_MEDIAN = 1.4826


class MergedFrames(Sequence):
    """The `rendered` frames of views, each with the depths of stereo up to `limit` where these are confirmed.

    `weight` is what rendered depths count elsewhere: the squared deviation of confirmed depths from those of their
    neighbours over that of rendered ones from confirmed ones, 1 at most. `confirmed` is the share of pixels that have
    confirmed depths.
    """

    def __init__(self, rendered: Sequence[DepthFrame], views: Sequence[View], limit: float, *, quiet: bool = True):
        self.rendered, self.limit = rendered, limit
        points = np.concatenate([_some(frame.surface()[0], POINTS // len(views)) for frame in rendered])
        maps = depth_maps(views, points, quiet=quiet)
        self.depths = [_confirmed_depth(found) for found in maps]
        self.confirmed = float(np.mean([np.isfinite(depth).mean() for depth in self.depths]))
        self.weight = _rendered_weight(maps, self.depths, rendered)

    def __len__(self) -> int:
        return len(self.rendered)

    def __getitem__(self, index):
        return self._merged(self.rendered[index], self.depths[index])

    def __iter__(self) -> Iterator[DepthFrame]:
        return map(self._merged, self.rendered, self.depths)

    def _merged(self, frame: DepthFrame, depth: np.ndarray) -> DepthFrame:
        known = depth <= self.limit  # not where it is NaN
        if frame.background is not None:
            # Beside an outline the windows of stereo take the background for a part of what is in front of it.
            known &= ~frame.background
        clamped = None if frame.clamped is None else frame.clamped & ~known
        return DepthFrame(
            frame.camera,
            np.where(known, depth, frame.depth).astype(np.float32),
            background=frame.background,
            confidence=np.where(known, np.float32(1), np.float32(self.weight)),
            clamped=clamped,
        )


def _some(points: np.ndarray, count: int) -> np.ndarray:
    """About `count` of (P, 3) points, evenly over their order."""
    return points[:: max(1, len(points) // max(1, count))]


def _confirmed_depth(found: DepthMap) -> np.ndarray:
    """(H, W) depth, NaN where too few neighbours confirm it."""
    wanted = min(NEIGHBOURS, max(2, found.sources - 1))
    return np.where(found.confirmed >= wanted, found.depth, np.float32(np.nan))


def _rendered_weight(maps: Sequence[DepthMap], depths: Sequence[np.ndarray], rendered: Sequence[DepthFrame]) -> float:
    """See `MergedFrames`."""
    stereo, other = [np.zeros(0)], [np.zeros(0)]
    for found, depth, frame in zip(maps, depths, rendered, strict=True):
        both = np.isfinite(depth) & (frame.depth > 0)
        stereo.append(found.deviation[both])
        other.append(np.abs(frame.depth[both] / depth[both] - 1))
    deviations = np.concatenate(stereo), np.concatenate(other)
    if not len(deviations[0]):
        return 1.0
    # A difference of two depths of the same accuracy is larger than the error of one by sqrt(2).
    own, theirs = NORMAL_MEDIAN * np.median(deviations[0]) / np.sqrt(2), NORMAL_MEDIAN * np.median(deviations[1])
    return float(min(1.0, own**2 / max(theirs**2, 1e-30)))
