"""Planes fitted to points, turned to the axes of their room.

Depths along an edge are known to a hundredth, and surfaces nearly flush with a wall are in front of it by as much: a
door and its frame, or cupboards and the refrigerator beside them. The plane with the most inliers then leans from one
to the other. Planes with points all over fix the axes of the room, the more so the more points they have, and of planes
along these the one with the most inliers is one of the two. Where a wall has only one well known edge, such as the
skirting along which the camera moved, the planes of single photographs lean by ten degrees to all sides and no two
agree, unless they are turned to the axes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from linprim_geo.geometry.camera import Camera
from linprim_geo.stereo.depth_maps import DepthMap
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
from linprim_geo.stereo.planes.point_planes import closeness, confirmed_points, planes_of_points, with_normal
from linprim_geo.stereo.planes.right_angles import MOST_ANGLE_ERROR, NEARLY, angles_to, frame_of

# A plane is turned only if it keeps more than this share of its points within half of TOLERANCE, or of their closeness.
# Truly leaning planes, such as a sloping street, keep fewer (DECISIONS 141, 155).
KEPT_SHARE = 0.75
# Two of the views that find a plane along the frame have to look from directions that differ by this angle in radians:
# less than usual, as its normal is known.
FRAMED_VIEW_ANGLE = SAME_ANGLE


def framed_planes_of_points(
    maps: Sequence[DepthMap], depths: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the (K, 4) planes with the most inliers among the confirmed `depths` (H, W) of views, NaN elsewhere, and
    their frame (3, 3), None if they have none. Planes that are nearly along the frame are turned to it, and others that
    are nearly at a right angle to one of its axes to this right angle: a roof is at right angles to the gable."""
    points, rng = confirmed_points(maps, depths)
    planes, weight = planes_of_points(points, rng)
    frame = frame_of(planes[:, :3], weight)
    if frame is None:
        return planes, None
    own = points.residuals(planes).argmin(1)  # points of parallel planes nearby would draw a plane to these
    for k, plane in enumerate(planes):
        mine = points[own == k]
        for normal in _normals_in(frame, plane, NEARLY):
            turned = with_normal(mine, plane, normal)
            before, after = (closeness(mine.residuals(each[None])).sum() for each in (plane, turned))
            if after > KEPT_SHARE * before:
                planes[k] = turned
                break
    return planes, frame


def _normals_in(frame: np.ndarray, plane: np.ndarray, most_angle: float) -> list[np.ndarray]:
    """Return the normals (3,) to which a plane may be turned: the nearest axis of a frame, if it is within `most_angle`
    (radians), and the nearest at a right angle to an axis, if the plane nearly is."""
    along, normals = frame @ plane[:3], []
    nearest, across = np.abs(along).argmax(), np.abs(along).argmin()
    if angles_to(frame, plane[None, :3])[0] < most_angle:
        normals.append(np.sign(along[nearest]) * frame[nearest])
    if np.abs(along[across]) < np.sin(NEARLY):
        normal = plane[:3] - along[across] * frame[across]
        normals.append(normal / np.linalg.norm(normal))
    return normals


def planes_by_edges(cameras: Sequence[Camera], regions: Sequence[PlainRegion], frame: np.ndarray | None) -> np.ndarray:
    """Return (K, 4) planes n . x = d of the world fitted to points along edges of plain `regions`: those that several
    views find, either as they are or once each is turned to a `frame` (3, 3). Those that are nearly along the frame, or
    at a right angle to one of its axes, are turned to it (`along_frame`)."""
    found = found_planes(cameras, regions)
    planes = common_planes(cameras, regions, found)
    if frame is None:
        return planes
    turned = [other for one in found if (other := _turned(cameras, one, frame)) is not None]
    planes = np.concatenate([planes, agreeing(cameras, turned, FRAMED_VIEW_ANGLE)[0]])
    return along_frame(cameras, regions, planes, frame)


def _turned(cameras: Sequence[Camera], one: FoundPlane, frame: np.ndarray) -> FoundPlane | None:
    """Return the plane of a region turned to a frame, or None if it is not turned (`_PlanePoints.turned`)."""
    points = _edge_points(cameras, [one.region], one.plane[None])[0]
    plane = points.turned(one.plane, frame)
    return None if plane is one.plane else FoundPlane.on(cameras[one.region.view], one.region, one.points, plane)


def along_frame(
    cameras: Sequence[Camera], regions: Sequence[PlainRegion], planes: np.ndarray, frame: np.ndarray
) -> np.ndarray:
    """Turn (K, 4) planes n . x = d of edges of plain `regions`, sorted by descending inlier count, to a `frame` (3, 3)
    (`_PlanePoints.turned`). Return all without duplicates, of which the first is kept."""
    kept = list[np.ndarray]()
    for plane, points in zip(planes, _edge_points(cameras, regions, planes), strict=True):
        plane = points.turned(plane, frame)
        if not any(points.has(other) for other in kept if abs(other[:3] @ plane[:3]) > 1 - 1e-9):
            kept.append(plane)
    return np.array(kept).reshape(-1, 4)


class _PlanePoints:
    """Points near a plane: `points` (P, 3) of the world, and `vectors` (P, 3) to them from the cameras that see
    them."""

    def __init__(self, points: np.ndarray, vectors: np.ndarray):
        self.points, self.vectors = points, vectors

    def turned(self, plane: np.ndarray, frame: np.ndarray) -> np.ndarray:
        """Return the plane turned to the nearest axis of a frame, or else to a right angle with an axis, and shifted to
        where most of the points are; unchanged if it is nearly along neither or loses too many inliers by both."""
        turned = (self._turned_to(normal, plane) for normal in _normals_in(frame, plane, MOST_ANGLE_ERROR))
        return next((each for each in turned if each is not None), plane)

    def _turned_to(self, normal: np.ndarray, plane: np.ndarray) -> np.ndarray | None:
        """Return the plane with another `normal` (3,) where most of the points are, or None if it loses too many
        inliers."""
        if not len(self.points):
            return None
        turned = shifted(np.append(normal, np.median(self.points @ normal)), self.points, self.vectors)
        on, before = (np.abs(self._off(each)) < TOLERANCE / 2 for each in (turned, plane))
        if np.count_nonzero(on) <= KEPT_SHARE * np.count_nonzero(before):
            return None
        turned[3] = np.average(self.points[on] @ normal, weights=(self.vectors[on] @ normal) ** -2)
        return turned

    def has(self, other: np.ndarray) -> bool:
        """Return whether the median residual of the points to another plane is within TOLERANCE."""
        return len(self.points) > 0 and float(np.median(np.abs(self._off(other)))) < TOLERANCE

    def _off(self, plane: np.ndarray) -> np.ndarray:
        return plane_residuals(plane, self.points, self.vectors)


def _edge_points(cameras: Sequence[Camera], regions: Sequence[PlainRegion], planes: np.ndarray) -> list[_PlanePoints]:
    """Return the points near each of (K, 4) planes along the edges of regions that may lie on it."""
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
    return [_PlanePoints(*map(np.concatenate, own)) for own in zip(points, vectors, strict=True)]
