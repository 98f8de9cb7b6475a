"""Planes fitted to points along edges, turned to the axes of their room.

Depths along an edge are known to a hundredth, and surfaces nearly flush with a wall are in front of it by as much: a
door and its frame, or cupboards and the refrigerator beside them. The plane with the most inliers then leans from one
to the other. Planes with points all over fix the axes of the room, and of planes along these the one with the most
inliers is one of the two. Where a wall has only one well known edge, such as the skirting along which the camera moved,
the planes of single photographs lean by ten degrees to all sides and no two agree, unless they are turned to the axes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from linprim_geo.geometry.camera import Camera
from linprim_geo.stereo.planes.constrained_planes import plane_residuals, shifted
from linprim_geo.stereo.planes.plain_regions import (
    BEHIND,
    SAME_ANGLE,
    TOLERANCE,
    FoundPlane,
    PlainRegion,
    agreeing,
    common_planes,
    found_planes,
    in_camera,
    may_lie_on,
    to_world,
)
from linprim_geo.stereo.planes.right_angles import MOST_ANGLE_ERROR, angles_to, frame_of

# A plane is turned only if it keeps more than this share of its points within half of TOLERANCE. Truly leaning planes,
# such as a sloping street, keep fewer (DECISIONS 141).
KEPT_SHARE = 0.75
# Two of the views that find a plane along the frame have to look from directions that differ by this angle in radians:
# less than usual, as its normal is known.
FRAMED_VIEW_ANGLE = SAME_ANGLE


def planes_by_edges(cameras: Sequence[Camera], regions: Sequence[PlainRegion], by_points: np.ndarray) -> np.ndarray:
    """Return (K, 4) planes n . x = d of the world fitted to points along edges of plain `regions`: those that several
    views find, either as they are or once each is turned to the frame of the planes `by_points` (N, 4). Those that are
    nearly along the frame are turned to it (`along_frame`)."""
    found = found_planes(cameras, regions)
    planes, frame = common_planes(cameras, regions, found), frame_of(by_points[:, :3])
    if frame is None:
        return planes
    turned = [other for one in found if (other := _turned(cameras, one, frame)) is not None]
    return along_frame(
        cameras, regions, np.concatenate([planes, agreeing(cameras, turned, FRAMED_VIEW_ANGLE)[0]]), by_points
    )


def _turned(cameras: Sequence[Camera], one: FoundPlane, frame: np.ndarray) -> FoundPlane | None:
    """Return the plane of a region turned to the nearest axis of a frame, or None if it is not nearly along one, or
    loses too many points."""
    points = _edge_points(cameras, [one.region], one.plane[None])[0]
    if angles_to(frame, one.plane[None, :3])[0] >= MOST_ANGLE_ERROR or not len(points.points):
        return None
    plane = points.turned(one.plane, frame)
    return None if plane is one.plane else FoundPlane.on(cameras[one.region.view], one.region, one.points, plane)


def along_frame(
    cameras: Sequence[Camera], regions: Sequence[PlainRegion], planes: np.ndarray, by_points: np.ndarray
) -> np.ndarray:
    """Turn those of (K, 4) planes n . x = d of edges of plain `regions`, sorted by descending inlier count, that are
    nearly along the frame of the planes `by_points` (N, 4). Return all without duplicates, of which the first is
    kept."""
    frame = frame_of(by_points[:, :3])
    if frame is None:
        return planes
    kept = list[np.ndarray]()
    of_planes = zip(planes, angles_to(frame, planes[:, :3]), _edge_points(cameras, regions, planes), strict=True)
    for plane, angle, points in of_planes:
        if angle < MOST_ANGLE_ERROR and len(points.points):
            plane = points.turned(plane, frame)
        if not any(points.has(other) for other in kept if abs(other[:3] @ plane[:3]) > 1 - 1e-9):
            kept.append(plane)
    return np.array(kept).reshape(-1, 4)


class _EdgePoints:
    """Points near a plane along the edges of regions that may lie on it: `points` (P, 3) of the world, and `vectors`
    (P, 3) to them from the cameras that see them."""

    def __init__(self, points: np.ndarray, vectors: np.ndarray):
        self.points, self.vectors = points, vectors

    def turned(self, plane: np.ndarray, frame: np.ndarray) -> np.ndarray:
        """Return the plane turned to the nearest axis of a frame and shifted to where most of the points are; unchanged
        if it loses too many inliers."""
        axis = frame[np.abs(frame @ plane[:3]).argmax()]
        axis = axis * np.sign(axis @ plane[:3])
        turned = shifted(np.append(axis, np.median(self.points @ axis)), self.points, self.vectors)
        on, before = (np.abs(self._off(each)) < TOLERANCE / 2 for each in (turned, plane))
        if np.count_nonzero(on) <= KEPT_SHARE * np.count_nonzero(before):
            return plane
        turned[3] = np.average(self.points[on] @ axis, weights=(self.vectors[on] @ axis) ** -2)
        return turned

    def has(self, other: np.ndarray) -> bool:
        """Return whether the median residual of the points to another plane is within TOLERANCE."""
        return len(self.points) > 0 and float(np.median(np.abs(self._off(other)))) < TOLERANCE

    def _off(self, plane: np.ndarray) -> np.ndarray:
        return plane_residuals(plane, self.points, self.vectors)


def _edge_points(cameras: Sequence[Camera], regions: Sequence[PlainRegion], planes: np.ndarray) -> list[_EdgePoints]:
    """Return the edge points of each of (K, 4) planes."""
    none = np.zeros((0, 3))
    points, vectors = [[none] for _ in planes], [[none] for _ in planes]
    for region in regions:
        camera = cameras[region.view]
        local = in_camera(camera, planes)
        near = region.sure[:, None] & (np.abs(region.residuals(local)) < BEHIND * TOLERANCE)
        for k in np.flatnonzero(may_lie_on(region, local)[1]):
            own = near[:, k]
            points[k].append(to_world(camera, region.rays[own] / region.inverse[own, None]))
            vectors[k].append(points[k][-1] - camera.center)
    return [_EdgePoints(*map(np.concatenate, own)) for own in zip(points, vectors, strict=True)]
