"""Depth maps for fusing out of three sources: what stereo finds and its neighbours confirm, planes of regions without
texture, and what the primitives render everywhere else, with the weight that its deviation from the first deserves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from linprim_geo.capture.types import View
from linprim_geo.stereo.depth_maps import DepthMap, depth_maps, grey_of, noise_of
from linprim_geo.stereo.plain_regions import common_planes, edges_of, plain_regions, plane_depths
from linprim_geo.surface.tsdf_field import DepthFrame

# A depth counts as confirmed if so many neighbours confirm it, or all but one of fewer.
NEIGHBOURS = 3
# Points of the rendered surface by which stereo finds pairs of views.
POINTS = 20_000


class MergedFrames(Sequence):
    """The `rendered` frames of views, each with the depths of stereo up to `limit` where these are confirmed, and those
    of planes where there is no texture.

    `weight` is what rendered depths count elsewhere: the squared deviation of confirmed depths from those of their
    neighbours over that of rendered ones from confirmed ones, 1 at most. `confirmed` is the share of pixels with
    confirmed depths, `plain` that of pixels on one of the `planes` (K, 4).
    """

    def __init__(self, rendered: Sequence[DepthFrame], views: Sequence[View], limit: float, *, quiet: bool = True):
        self.rendered, self.limit = rendered, limit
        points = np.concatenate([_some(frame.surface()[0], POINTS // len(views)) for frame in rendered])
        maps = depth_maps(views, points, quiet=quiet)
        self.depths = [_confirmed_depth(found) for found in maps]
        self.confirmed = float(np.mean([np.isfinite(depth).mean() for depth in self.depths]))
        self.weight = _rendered_weight(maps, self.depths, rendered)
        self.planes, self.on_planes = _planes(views, self.depths, rendered)
        self.plain = float(np.mean([np.isfinite(depth).mean() for depth in self.on_planes]))

    def about(self) -> dict:
        """For the statistics."""
        return {
            "confirmed": self.confirmed,
            "rendered_weight": self.weight,
            "plain": self.plain,
            "planes": len(self.planes),
        }

    def __len__(self) -> int:
        return len(self.rendered)

    def __getitem__(self, index):
        return self._merged(self.rendered[index], self.depths[index], self.on_planes[index])

    def __iter__(self) -> Iterator[DepthFrame]:
        return map(self._merged, self.rendered, self.depths, self.on_planes)

    def _merged(self, frame: DepthFrame, confirmed: np.ndarray, on_plane: np.ndarray) -> DepthFrame:
        depth, weight = frame.depth, np.full(frame.depth.shape, self.weight, np.float32)
        known = np.zeros(depth.shape, bool)
        for source in (on_plane, confirmed):
            better = source <= self.limit  # not where it is NaN
            if frame.background is not None:
                # Beside an outline the windows of stereo take the background for a part of what is in front of it.
                better &= ~frame.background
            depth, weight = np.where(better, source, depth), np.where(better, np.float32(1), weight)
            known |= better
        clamped = None if frame.clamped is None else frame.clamped & ~known
        return DepthFrame(
            frame.camera,
            depth.astype(np.float32),
            background=frame.background,
            confidence=weight,
            clamped=clamped,
        )


def _some(points: np.ndarray, count: int) -> np.ndarray:
    """About `count` of (P, 3) points, evenly over their order."""
    return points[:: max(1, len(points) // max(1, count))]


def _confirmed_depth(found: DepthMap) -> np.ndarray:
    """(H, W) depth, NaN where too few neighbours confirm it."""
    wanted = min(NEIGHBOURS, max(2, found.sources - 1))
    return np.where(found.confirmed >= wanted, found.depth, np.float32(np.nan))


def _planes(
    views: Sequence[View], depths: Sequence[np.ndarray], rendered: Sequence[DepthFrame]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """The (K, 4) planes of regions without texture, and for each view (H, W) depths on them, NaN elsewhere."""
    regions = []
    for number, (view, depth) in enumerate(zip(views, depths, strict=True)):
        grey = grey_of(view)
        regions.append(plain_regions(number, view.camera, edges_of(grey, noise_of(grey)), depth))
    cameras = [view.camera for view in views]
    planes = common_planes(cameras, [region for own in regions for region in own])
    frames = zip(cameras, regions, rendered, strict=True)
    return planes, [plane_depths(camera, own, planes, frame.depth) for camera, own, frame in frames]


def _rendered_weight(maps: Sequence[DepthMap], depths: Sequence[np.ndarray], rendered: Sequence[DepthFrame]) -> float:
    """See `MergedFrames`."""
    stereo, other = [np.zeros(0)], [np.zeros(0)]
    for found, depth, frame in zip(maps, depths, rendered, strict=True):
        both = np.isfinite(depth) & (frame.depth > 0)
        stereo.append(found.deviation[both])
        other.append(np.abs(frame.depth[both] / depth[both] - 1))
    own, theirs = np.concatenate(stereo), np.concatenate(other)
    if not len(own):
        return 1.0
    # A difference of two depths of the same accuracy is larger than the error of one by sqrt(2).
    ratio = np.median(own) / np.sqrt(2) / max(float(np.median(theirs)), 1e-15)
    return float(min(1.0, ratio**2))
