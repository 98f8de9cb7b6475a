"""Extend floors and walls into pixels of unknown depth: planes behind which nothing lies.

A plane encloses the scene if all cameras and nearly all known points (except those in recesses such as doors) lie on
one side of it, and either another such plane is at a right angle to it or its points are all over it, as on a table. A
ray of unknown depth ends at the first of these planes, within the rectangle around the plane's own points: walls do not
reach into the sky. Where hardly any view looks, as below a table, a rectangle around all known points counts, if the
plane's points span that in one direction. Where most views that look at a place know its depth and one does not, an
object is assumed in front of it. Where two enclosing planes end together, a third closes the room: a plain wall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import distance_transform_edt

from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels import surface_ops
from linprim_geo.points.view_pairs import SOURCES, visible_pixels
from linprim_geo.stereo.evidence import CONFIRMED_DEPTH
from linprim_geo.stereo.planes.common_surfaces import ON_IT
from linprim_geo.stereo.planes.plain_regions import PlainRegion, in_camera, rays_of, to_world
from linprim_geo.stereo.planes.point_planes import LEAST_SHARE, SAME_NORMAL, SurfacePoints
from linprim_geo.stereo.planes.right_angles import at_right_angles

# This share of the known points may be wrong, and lie behind a plane or beyond its end.
OUTLIERS = 0.01
# A point is behind a plane if it is by more than this share of its distance: twice the error of confirmed depths.
MARGIN = 2 * CONFIRMED_DEPTH
# Two planes end at the same place if their ends, each known to MARGIN, differ by at most so many times MARGIN.
ENDS_APART = np.sqrt(2)
# A door or a window is set back from its wall by at most this share of its distance: 15 cm at 3 m.
RECESS = 5 * CONFIRMED_DEPTH
# At most this share of the known points in the direction of a wall may lie behind it. It is more than OUTLIERS, as a
# plain wall has few points of its own. The points in its direction count as LEAST_AIMED at least.
SEEN_THROUGH, LEAST_AIMED = 0.05, 100
# The share of a plane's points that may lie beyond either end, and the error of the ends, as a share of the distance
# between them.
BEYOND, END_MARGIN = 0.002, 0.02
# A plane whose points reach along this share of the scene in one direction bounds it, and may be extended in the other.
# The front of a sideboard does not reach as far.
SPANNING = 0.9
# If more than this share of the views that look at a place know its depth, a view that knows none there has an object
# in front of it.
MOST_KNOW = 0.5
# Points are all over a plane if they fill the share FILLED of CELLS by CELLS cells of their rectangle, the smallest
# over DIRECTIONS orientations. On a false plane, through a row of eaves and the sky, they fill few.
CELLS, FILLED, DIRECTIONS = 8, 0.5, 45
# A plane is level if its normal is within 60 degrees of the mean up direction of the photographs, whose cameras may
# look far down.
UPRIGHT = np.cos(np.radians(60))
# Stereo knows up to SURE_SHARE of a plain region by chance. If it knows more, AGREEING of these depths have to be
# inliers of the plane of the region.
SURE_SHARE, AGREEING = 0.1, 0.7
# Stereo compares each view with so many others. Where no more than that look at a place, stereo may know nothing of a
# surface there.
FEW_VIEWS = SOURCES


@dataclass(frozen=True)
class EnclosingPlane:
    """A plane normal . x = offset; its `normal` (3,) points towards the cameras.

    `axes` (2, 3) are unit vectors within the plane. `own` (2, 2) are the least and greatest coordinates along them of
    the plane's own points; `whole` (2, 2) those of all known points if its own span one axis as far, else the same as
    `own`. A plane that `closes` the scene stands where two others end. An `inner` one, a wall of a room that is not
    convex, does not reach beyond its own rectangle.
    """

    normal: np.ndarray
    offset: float
    axes: np.ndarray
    own: np.ndarray
    whole: np.ndarray
    closes: bool = False
    inner: bool = False

    def as_vector(self) -> np.ndarray:
        """Return (4,) normal and offset."""
        return np.append(self.normal, self.offset)

    def at(self, along: np.ndarray) -> np.ndarray:
        """Return (..., 3) points of the plane at (..., 2) coordinates along its axes."""
        return along @ self.axes + self.normal * self.offset

    def within(self, points: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Return (P,) bool: which of (P, 3) points on the plane lie within the rectangle `ends`, `own` or `whole`."""
        first, second = (points @ self.axes.T).T
        return (first >= ends[0, 0]) & (first <= ends[1, 0]) & (second >= ends[0, 1]) & (second <= ends[1, 1])

    def corners(self) -> np.ndarray:
        """Return the (4, 3) corners of its own rectangle."""
        return self.at(np.array([[x, y] for x in self.own[:, 0] for y in self.own[:, 1]]))

    def with_place_for(self, points: np.ndarray) -> EnclosingPlane:
        """Return the plane with both rectangles enlarged to hold the projections of (P, 3) points."""
        along = points @ self.axes.T
        own, whole = (
            np.stack([np.minimum(ends[0], along.min(0)), np.maximum(ends[1], along.max(0))])
            for ends in (self.own, self.whole)
        )
        return replace(self, own=own, whole=whole)


def enclosing_planes(
    cameras: Sequence[Camera],
    planes: np.ndarray,
    points: SurfacePoints,
    standing: np.ndarray | None = None,
    known: SurfacePoints | None = None,
) -> list[EnclosingPlane]:
    """Return those of (K, 4) planes n . x = d that enclose the scene, without duplicates, and closing planes at right
    angles to two of them where both end. A plane that is at a right angle to no other is kept only if points are all
    over it.

    Walls that are `standing` (K,), on a line which photographs show, need only few points. `points` tell where planes
    end and another closes, unless further `known` points continue there; the planes' rectangles hold these as well.
    """
    if not len(points):
        return []
    seen = ScenePoints(cameras, points)
    every = seen if known is None else ScenePoints(cameras, SurfacePoints.together([points, known]))
    standing = np.zeros(len(planes), bool) if standing is None else standing
    sides = [
        seen.facing(plane)
        for plane, stands in zip(planes, standing, strict=True)
        if seen.is_enclosing(seen.facing(plane), least=0 if stands else LEAST_SHARE)
    ]
    found = seen.without_copies(sides)
    corners = [plane for plane in found if any(at_right_angles(plane, other) for other in found)]
    enclosing = [
        every.with_ends(plane, corners, every.points.on(plane[None], CONFIRMED_DEPTH)[:, 0])
        for plane in found
        if any(plane is corner for corner in corners)
        or seen.is_filled(plane, points.on(plane[None], CONFIRMED_DEPTH)[:, 0])
    ]
    closing = (every.with_ends(plane, corners, slice(None)) for plane in seen.closing(corners, every))
    return enclosing + [replace(plane, closes=True) for plane in closing]


class ScenePoints:
    """Known points of the scene, to judge planes (4,) n . x = d with normals towards the cameras."""

    def __init__(self, cameras: Sequence[Camera], points: SurfacePoints):
        self.cameras, self.points = cameras, points
        self.centers = np.array([camera.center for camera in cameras])
        self.distance = np.linalg.norm(points.position - points.center, axis=1)

    def is_level(self, plane: np.ndarray) -> bool:
        """Return whether a plane (4,), or its normal (3,), is that of a floor or a table top."""
        upward = -np.mean([camera.rotation[1] for camera in self.cameras], axis=0)
        return bool(plane[:3] @ upward > UPRIGHT * np.linalg.norm(upward))

    def facing(self, plane: np.ndarray) -> np.ndarray:
        """Return the plane with its normal towards the cameras."""
        return plane if (self.centers @ plane[:3]).mean() > plane[3] else -plane

    def is_enclosing(self, plane: np.ndarray, least: float = LEAST_SHARE) -> bool:
        """Return whether at least the share `least` of the points are inliers of the plane with similar normals, and
        hardly any lies behind it, except a share of up to SEEN_THROUGH in recesses."""
        on = self.points.on(plane[None], CONFIRMED_DEPTH)
        return (
            bool(on.any())
            and on.mean() >= least
            and self.is_before_all(plane, RECESS)
            and self.share_behind(plane, MARGIN) < SEEN_THROUGH
        )

    def is_before_all(self, plane: np.ndarray, margin: float = MARGIN) -> bool:
        """Return whether all cameras are in front of a plane, and hardly any point is behind it by more than the share
        `margin` of its distance."""
        return self.share_behind(plane, margin) < OUTLIERS and bool((self.centers @ plane[:3] > plane[3]).all())

    def share_behind(self, plane: np.ndarray, margin: float) -> float:
        """Return the share of the points that are behind a plane by more than the share `margin` of their distance."""
        return float((self.height(plane) < -margin * self.distance).mean())

    def is_passed(self, wall: EnclosingPlane) -> bool:
        """Return whether more than SEEN_THROUGH of the known points seen through a wall's own rectangle, reduced by a
        margin, are behind the wall."""
        center, towards = self.points.center, self.points.position - self.points.center
        along = towards @ wall.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (wall.offset - center @ wall.normal) / along
        aimed = np.isfinite(share) & (share > 0)
        margin = self.margin_at(wall.at(wall.own.mean(0)))
        ends = wall.own + np.array([[margin], [-margin]])
        aimed[aimed] = wall.within(center[aimed] + share[aimed, None] * towards[aimed], ends)
        passing = np.count_nonzero(share[aimed] < 1 - MARGIN)
        return bool(passing > SEEN_THROUGH * max(LEAST_AIMED, int(aimed.sum())))

    def height(self, plane: np.ndarray) -> np.ndarray:
        """Return (P,) signed distances of the points from a plane, positive in front."""
        return self.points.position @ plane[:3] - plane[3]

    def on(self, plane: np.ndarray) -> np.ndarray:
        """Return (P,) bool: which points are inliers of a plane, regardless of their normals, which are bent in
        corners."""
        return np.abs(self.height(plane)) < CONFIRMED_DEPTH * self.distance

    def without_copies(self, planes: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the planes without duplicates, sorted by descending inlier count, those with points in recesses last.
        A plane is a duplicate if most of its inliers are also near an earlier, similar one: a plane between a floor and
        a board above it has inliers on both."""
        kept: list[np.ndarray] = []
        for plane in sorted(planes, key=lambda plane: (not self.is_before_all(plane), -self.on(plane).sum())):
            own = self.on(plane)
            alike = [other for other in kept if plane[:3] @ other[:3] > SAME_NORMAL]
            near = (np.abs(self.height(other)[own]) < MARGIN * self.distance[own] for other in alike)
            if not any(share.mean() > 0.5 for share in near):
                kept.append(plane)
        return kept

    def which_is_there(self, plane: EnclosingPlane, others: Sequence[EnclosingPlane]) -> int | None:
        """Return the index of the first of `others` that faces the same way as the plane and holds its middle, or
        None."""
        middle = plane.at(plane.own.mean(0))[None]
        for number, other in enumerate(others):
            if plane.normal @ other.normal > SAME_NORMAL and self.are_on(middle, other):
                return number
        return None

    def are_on(self, places: np.ndarray, plane: EnclosingPlane) -> bool:
        """Return whether (P, 3) points are all on a plane, within MARGIN of the median distance of the cameras."""
        near = self.margin_at(places.mean(0))
        return bool((np.abs(places @ plane.normal - plane.offset) < near).all())

    def margin_at(self, place: np.ndarray) -> float:
        """Return MARGIN in the unit of the scene, at a point (3,) seen from the median distance of the cameras."""
        return MARGIN * float(np.median(np.linalg.norm(self.centers - place, axis=1)))

    def closing(self, found: Sequence[np.ndarray], every: ScenePoints) -> list[np.ndarray]:
        """Return planes at right angles to two of those `found` where both end, also by the points of `every`, on sides
        without a plane. Points are scarce beside an end, so of several planes on one side the farthest from the cameras
        errs least."""
        candidates, closing = list[np.ndarray](), list[np.ndarray]()
        for number, first in enumerate(found):
            for second in (other for other in found[:number] if at_right_angles(first, other)):
                across = np.cross(first[:3], second[:3])
                across /= np.linalg.norm(across)
                sides = [self.on(plane) for plane in (first, second)]
                apart = MARGIN * min(np.median(self.distance[own]) for own in sides)
                for normal in (across, -across):
                    ends = [np.quantile(self.points.position[own] @ normal, OUTLIERS) for own in sides]
                    there = any(normal @ other[:3] > SAME_NORMAL for other in found)
                    plane = np.append(normal, np.mean(ends))
                    if there or abs(ends[0] - ends[1]) > ENDS_APART * apart or not every.is_before_all(plane):
                        continue
                    ending = all(every.ends_at(wall, plane, apart) for wall in (first, second))
                    if ending and all(self.ends_in_images(own, plane, apart) for own in sides):
                        candidates.append(plane)
        middle = self.centers.mean(0)  # planes that are not quite parallel are compared there, not at the origin
        for plane in sorted(candidates, key=lambda plane: plane[3] - plane[:3] @ middle):
            if not any(plane[:3] @ other[:3] > SAME_NORMAL for other in closing):
                closing.append(plane)
        return closing

    def ends_at(self, plane: np.ndarray, end: np.ndarray, near: float) -> bool:
        """Return whether hardly any inlier of a plane is more than `near` beyond its end at another plane."""
        return bool((self.height(end)[self.on(plane)] < -near).mean() < OUTLIERS)

    def ends_in_images(self, own: np.ndarray, end: np.ndarray, near: float) -> bool:
        """Return whether most views of a plane's points within `near` of its end at another plane show what is beyond,
        so that the plane does not just end at the borders of photographs."""
        rows = np.flatnonzero(own & (self.height(end) < near))
        beyond = self.points.position[rows] - 2 * near * end[:3]
        views = self.points.view[rows]
        inside = [visible_pixels(self.cameras[view], beyond[views == view])[0] for view in np.unique(views)]
        return bool(np.concatenate(inside).mean() > 0.5)

    def with_ends(self, plane: np.ndarray, corners: Sequence[np.ndarray], own: np.ndarray | slice) -> EnclosingPlane:
        """Return a plane with the rectangle around its `own` points: along the normal of the first of the `corners` at
        a right angle to it, else the smallest rectangle, which is then not extended to other points."""
        normal = plane[:3]
        first = next((other[:3] for other in corners if at_right_angles(other, plane)), None)
        if first is None:
            axes, ends = self.smallest_rectangle(plane, own)
            return EnclosingPlane(normal, float(plane[3]), axes, ends, ends)
        axes = _axes(normal, first)
        along = self.points.position @ axes.T
        ends, whole = _ends(along[own]), _ends(along)
        spans = (np.diff(ends, axis=0) >= SPANNING * np.diff(whole, axis=0)).any()
        return EnclosingPlane(normal, float(plane[3]), axes, ends, whole if spans else ends)

    def smallest_rectangle(self, plane: np.ndarray, own: np.ndarray | slice) -> tuple[np.ndarray, np.ndarray]:
        """Return axes (2, 3) and ends (2, 2) of the smallest rectangle within a plane that holds its `own` points."""
        one, other = _axes(plane[:3], np.eye(3)[np.abs(plane[:3]).argmin()])
        points, tried = self.points.position[own], []
        for angle in np.linspace(0, np.pi / 2, DIRECTIONS, endpoint=False):
            axes = np.cos(angle) * np.stack([one, other]) + np.sin(angle) * np.stack([other, -one])
            ends = _ends(points @ axes.T)
            tried.append((float(np.diff(ends, axis=0).prod()), axes, ends))
        _, axes, ends = min(tried, key=lambda each: each[0])
        return axes, ends

    def is_filled(self, plane: np.ndarray, own: np.ndarray) -> bool:
        """Return whether a plane's `own` points are all over their rectangle."""
        axes, ends = self.smallest_rectangle(plane, own)
        along = (self.points.position[own] @ axes.T - ends[0]) / np.diff(ends, axis=0)
        cells = np.floor(CELLS * along[(along >= 0).all(1) & (along < 1).all(1)]).astype(int)
        return len(np.unique(cells, axis=0)) >= FILLED * CELLS**2


def _axes(normal: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return (2, 3) unit vectors orthogonal to a `normal` and to each other, the first as close as possible to
    `near`."""
    first = near - normal * (near @ normal)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


def _ends(along: np.ndarray) -> np.ndarray:
    """Return the (2, 2) least and greatest of (P, 2) coordinates, without outliers and with a margin."""
    low, high = np.quantile(along, [BEYOND, 1 - BEYOND], axis=0)
    return np.stack([low, high]) + END_MARGIN * np.stack([low - high, high - low])


def enclosing_depths(
    cameras: Sequence[Camera],
    enclosing: Sequence[EnclosingPlane],
    known: Sequence[np.ndarray],
    wanted: Sequence[np.ndarray],
    shown: Sequence[np.ndarray],
    doubtful: Sequence[np.ndarray],
) -> list[np.ndarray]:
    """Return the (H, W) float32 depth of every view at `wanted` pixels whose rays end at an enclosing plane, NaN
    elsewhere.

    Args:
        known: (H, W) depth of every view, NaN where unknown.
        wanted: (H, W) bool of every view: pixels that need a depth.
        shown: (H, W) probable depth of every view, NaN where none is more probable than others; a plane has to be near
            it.
        doubtful: (H, W) depth of every view, NaN where none, that confirms a plane near it. Without that, a place whose
            depth more than MOST_KNOW of the views know is not taken for a pixel of unknown depth.
    """
    result = [np.full(depth.shape, np.nan, np.float32) for depth in known]
    for camera, depth, pixels, probable, supposed in zip(cameras, result, wanted, shown, doubtful, strict=True):
        row, column = np.nonzero(pixels)
        if not len(row) or not enclosing:
            continue
        rays = rays_of(camera, row, column)
        nearest, own, whole = _first_met(camera, rays, enclosing)
        elsewhere = np.abs(probable[row, column] * nearest - 1) > MARGIN  # false for NaN
        rows = np.flatnonzero((own | whole) & ~elsewhere)
        looking, knowing = _looking(to_world(camera, rays[rows] / nearest[rows, None]), cameras, known)
        on_it = np.abs(supposed[row[rows], column[rows]] * nearest[rows] - 1) <= ON_IT
        rows = rows[(own[rows] | (looking <= FEW_VIEWS)) & (on_it | (knowing <= MOST_KNOW * looking))]
        depth[row[rows], column[rows]] = 1 / nearest[rows]
    return result


def _first_met(
    camera: Camera, rays: np.ndarray, enclosing: Sequence[EnclosingPlane]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Intersect (N, 3) rays of a camera with the enclosing planes. Return (N,) inverse depths of the first plane met,
    not positive where none, and (N,) bool whether the point is within its `own` rectangle, and within `whole`."""
    planes = np.array([plane.as_vector() for plane in enclosing])
    inverse = rays @ in_camera(camera, planes).T
    for number, plane in enumerate(enclosing):
        if plane.inner:
            rows = np.flatnonzero(inverse[:, number] > 0)
            places = to_world(camera, rays[rows] / inverse[rows, number, None])
            inverse[rows[~plane.within(places, plane.own)], number] = 0
    first, nearest = inverse.argmax(1), inverse.max(1)
    own, whole = np.zeros(len(rays), bool), np.zeros(len(rays), bool)
    for number, plane in enumerate(enclosing):
        rows = np.flatnonzero((first == number) & (nearest > 0))
        places = to_world(camera, rays[rows] / nearest[rows, None])
        own[rows], whole[rows] = plane.within(places, plane.own), plane.within(places, plane.whole)
    return nearest, own, whole


def region_depths(
    camera: Camera, enclosing: Sequence[EnclosingPlane], known: np.ndarray, regions: Sequence[PlainRegion]
) -> np.ndarray:
    """Return the (H, W) float32 depth of enclosing planes in those plain regions of a view that lie on them, NaN
    elsewhere. An object in front of a wall would have an edge.

    Of the `known` depths (H, W) within a region, NaN elsewhere, the share AGREEING has to be inliers, and there have to
    be more than chance gives. As edges may have gaps, a pixel takes the plane only if the nearest known pixel is an
    inlier.
    """
    depth = np.full(known.shape, np.nan, np.float32)
    for region in regions if enclosing else ():
        row, column = np.nonzero(region.mask)
        at = row + region.top, column + region.left
        nearest, own, whole = _first_met(camera, rays_of(camera, *at), enclosing)
        met, is_known = own | whole, np.isfinite(known[at])
        on = met & (np.abs(known[at] * nearest - 1) < MARGIN)
        if np.count_nonzero(is_known) < SURE_SHARE * len(row) or on.sum() < AGREEING * np.count_nonzero(is_known):
            continue
        unknown, lying = np.ones(region.mask.shape, bool), np.zeros(region.mask.shape, bool)
        unknown[row, column], lying[row, column] = ~is_known, on
        _, (near_row, near_column) = distance_transform_edt(unknown, return_indices=True)
        taken = met & lying[near_row, near_column][row, column]
        depth[at[0][taken], at[1][taken]] = 1 / nearest[taken]
    return depth


def known_on_planes(
    cameras: Sequence[Camera], enclosing: Sequence[EnclosingPlane], known: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return (H, W) bool of every view: where a `known` depth (H, W), NaN where none, lies on an enclosing plane within
    its own rectangle, at a place at which few views look, most of which know it. With few photographs training explains
    such places by any background, so that depths of stereo count there all the same."""
    result = [np.zeros(depth.shape, bool) for depth in known]
    for camera, depth, on in zip(cameras, known, result, strict=True):
        row, column = np.nonzero(np.isfinite(depth))
        places = to_world(camera, rays_of(camera, row, column) * depth[row, column, None])
        least = CONFIRMED_DEPTH * np.linalg.norm(places - camera.center, axis=1)
        near = np.zeros(len(places), bool)
        for plane in enclosing:
            on_it = np.flatnonzero(np.abs(places @ plane.normal - plane.offset) < least)
            near[on_it[plane.within(places[on_it], plane.own)]] = True
        looking, knowing = _looking(places[near], cameras, known)
        on[row[near], column[near]] = (looking <= FEW_VIEWS) & (knowing > MOST_KNOW * looking)
    return result


def _looking(
    points: np.ndarray, cameras: Sequence[Camera], known: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return (N,) how many views look at (N, 3) points, which are in the image with no known depth in front, and (N,)
    how many of these know a depth at the point."""
    depths = (np.ascontiguousarray(depth, np.float32) for depth in known)
    views = [(*camera.pinhole(), depth) for camera, depth in zip(cameras, depths, strict=True)]
    return surface_ops.count_looking_views(views, np.ascontiguousarray(points), MARGIN)
