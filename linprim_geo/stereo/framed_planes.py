"""Planes of edges, turned along the frame of their room.

Depths along an edge are known to a hundredth, and what is nearly flush with a wall is before it by as much: a door and
its frame, a row of cupboards and the refrigerator beside them. The plane with the most points on it leans from the one
to the other. Planes with points all over know the directions of the room, and of planes along these the one with the
most points is one of the two.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from linprim_geo.geometry.camera import Camera
from linprim_geo.stereo.held_planes import ALIKE_DEPTH, commonest_offset
from linprim_geo.stereo.plain_regions import BEHIND, TOLERANCE, PlainRegion, in_camera, may_lie_on, to_world
from linprim_geo.stereo.right_angles import LEFT_OPEN, angles_to, frame_of

# Of the points within half of TOLERANCE of a plane at least such a share is there once it is turned: of planes that
# lean by themselves, as a sloping street does, fewer stay (DECISIONS 141).
KEPT_SHARE = 0.75


def along_frame(
    cameras: Sequence[Camera], regions: Sequence[PlainRegion], planes: np.ndarray, by_points: np.ndarray
) -> np.ndarray:
    """(K, 4) planes n . x = d of the world that edges of plain `regions` have given, those with more points first, of
    which those nearly along the frame of the planes `by_points` (N, 4) are turned along it; of copies the first."""
    frame = frame_of(by_points[:, :3])
    if frame is None:
        return planes
    kept = list[np.ndarray]()
    for plane, angle in zip(planes, angles_to(frame, planes[:, :3]), strict=True):
        along = _Along(cameras, regions, plane)
        if angle < LEFT_OPEN and len(along.points):
            plane = along.turned(frame)
        if not any(along.has(other) for other in kept if abs(other[:3] @ plane[:3]) > 1 - 1e-9):
            kept.append(plane)
    return np.array(kept).reshape(-1, 4)


class _Along:
    """The `points` (P, 3) of the world along edges of `regions` that may lie on a plane, near it, and the vectors
    (P, 3) to them from the `cameras` that see them."""

    def __init__(self, cameras: Sequence[Camera], regions: Sequence[PlainRegion], plane: np.ndarray):
        points, vectors = [np.zeros((0, 3))], [np.zeros((0, 3))]
        for region in regions:
            camera = cameras[region.view]
            local = in_camera(camera, plane[None])
            if may_lie_on(region, local)[1][0]:
                near = region.sure & (np.abs(region.off(local)[:, 0]) < BEHIND * TOLERANCE)
                points.append(to_world(camera, region.rays[near] / region.inverse[near, None]))
                vectors.append(points[-1] - camera.center)
        self.plane, self.points, self.vectors = plane, np.concatenate(points), np.concatenate(vectors)

    def turned(self, frame: np.ndarray) -> np.ndarray:
        """The plane along the nearest axis of a frame that most of the points are on; the plane as it was where it
        loses too many."""
        axis = frame[np.abs(frame @ self.plane[:3]).argmax()]
        axis = axis * np.sign(axis @ self.plane[:3])
        turned = np.append(axis, np.median(self.points @ axis))
        off = self._off(turned)
        near = np.abs(off) < ALIKE_DEPTH
        if not near.any():
            return self.plane
        turned[3] += commonest_offset(off[near]) * np.median(self.vectors[near] @ axis)
        on = np.abs(self._off(turned)) < TOLERANCE / 2
        if np.count_nonzero(on) <= KEPT_SHARE * np.count_nonzero(np.abs(self._off(self.plane)) < TOLERANCE / 2):
            return self.plane
        turned[3] = np.average(self.points[on] @ axis, weights=(self.vectors[on] @ axis) ** -2)
        return turned

    def has(self, other: np.ndarray) -> bool:
        """Whether the points lie on another plane as well, in the median."""
        return len(self.points) > 0 and float(np.median(np.abs(self._off(other)))) < TOLERANCE

    def _off(self, plane: np.ndarray) -> np.ndarray:
        """(P,) how far points are beyond a plane, as shares of their distance along its normal."""
        with np.errstate(divide="ignore", invalid="ignore"):  # rays along the plane
            return (self.points @ plane[:3] - plane[3]) / (self.vectors @ plane[:3])
