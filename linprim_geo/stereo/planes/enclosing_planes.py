"""Floors and walls where nothing is known of them: planes behind which nothing lies go on.

A plane encloses the scene if all cameras and nearly all known points lie on one side of it, but for those in recesses
such as doors, and another such plane meets it at a right angle, as the floor and the walls of a room do, or its points
are all over it, as those of a table are. A ray of which nothing is known ends at the first of these, but only within
the rectangle that holds the plane's own known points, as walls do not go on into the sky. Where hardly any view looks,
as below a table, stereo can know nothing: there it ends within the rectangle that holds all known points, if the
plane's own reach across that one way. Where most of the views that look at a place know it, one that does not has
something before it, unless it has a doubtful depth there.

Of few photographs training can explain much as background: what hardly any view shows agrees with any far background.
There a depth of stereo on such a plane counts all the same (`known_on_planes`).

A plain wall in even light has no points. Where two planes that enclose the scene end at the same place, as a floor and
a wall do at the next wall, a plane at right angles to both closes the room there.
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

# Of the known points so many are wrong, and may lie behind a plane or beyond an end of it.
OUTLIERS = 0.01
# A point is behind a plane by more than this share of its distance: twice what depths may be off by.
MARGIN = 2 * CONFIRMED_DEPTH
# Two planes end at the same place if their ends, each of which is known to MARGIN, differ by so many times that.
ENDS_APART = np.sqrt(2)
# A door or a window stands back from its wall by up to so much of its distance: 15 cm from 3 m.
RECESS = 5 * CONFIRMED_DEPTH
# Nothing is known through a wall but for a share of what is known in its direction: more than OUTLIERS, as a plain wall
# has few points of its own. What is known in its direction counts for so many points at least.
SEEN_THROUGH, LEAST_AIMED = 0.05, 100
# So few of the points on a plane lie beyond its ends, and ends are known to this share of the distance between them.
BEYOND, END_MARGIN = 0.002, 0.02
# A plane whose points reach along this share of the scene one way bounds it, and may go on the other way. The front of
# a sideboard does not.
SPANNING = 0.9
# A place that more of the views looking at it know is not what a view sees that knows nothing: something is before it.
MOST_KNOW = 0.5
# The points of a plane are all over it if they are in a share FILLED of CELLS by CELLS parts of their rectangle, whose
# sides run along one of so many DIRECTIONS. On a plane through a row of eaves and the sky they are in a few.
CELLS, FILLED, DIRECTIONS = 8, 0.5, 45
# A plane is level if its normal is as near to the mean direction that is up in photographs, whose camera may look far
# down.
UPRIGHT = np.cos(np.radians(60))
# Stereo knows up to SURE_SHARE of a plain region by chance; of more depths, AGREEING are on a plane that it lies on.
SURE_SHARE, AGREEING = 0.1, 0.7
# So many views of each place are wanted for stereo: where no more look, it may know nothing of a surface.
FEW_VIEWS = SOURCES


@dataclass(frozen=True)
class EnclosingPlane:
    """A plane normal . x = offset, with (3,) `normal` towards the cameras.

    `axes` (2, 3) are unit vectors in it; `own` (2, 2) the least and greatest coordinates along them of its own known
    points, and `whole` of all known points if its own reach as far along one of the axes, else the same. One that
    `closes` the scene stands where two others end. An `inner` one, of a room that is not convex, is nothing beyond its
    own rectangle.
    """

    normal: np.ndarray
    offset: float
    axes: np.ndarray
    own: np.ndarray
    whole: np.ndarray
    closes: bool = False
    inner: bool = False

    def as_vector(self) -> np.ndarray:
        """(4,) normal and offset."""
        return np.append(self.normal, self.offset)

    def at(self, along: np.ndarray) -> np.ndarray:
        """(..., 3) points of the plane at (..., 2) coordinates along its axes."""
        return along @ self.axes + self.normal * self.offset

    def within(self, points: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """(P,) bool which of (P, 3) points on the plane lie within `own` or `whole`."""
        first, second = (points @ self.axes.T).T
        return (first >= ends[0, 0]) & (first <= ends[1, 0]) & (second >= ends[0, 1]) & (second <= ends[1, 1])

    def corners(self) -> np.ndarray:
        """(4, 3) of its own rectangle."""
        return self.at(np.array([[x, y] for x in self.own[:, 0] for y in self.own[:, 1]]))

    def with_place_for(self, points: np.ndarray) -> EnclosingPlane:
        """The plane with rectangles that hold (P, 3) points, too, projected onto it."""
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
    """Those of (K, 4) planes n . x = d that enclose the scene, without copies, of those that meet no other at right
    angles only what points are all over, and planes at right angles to two of them where both end.

    Of walls that are `standing` (K,) on the line that photographs show few points are enough. `points` tell where
    planes end that others close, unless further `known` points go on there; planes reach as far as these do."""
    if not len(points):
        return []
    seen = KnownPoints(cameras, points)
    every = seen if known is None else KnownPoints(cameras, SurfacePoints.together([points, known]))
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


class KnownPoints:
    """Known points, by which planes (4,) n . x = d are judged whose normals are towards the cameras."""

    def __init__(self, cameras: Sequence[Camera], points: SurfacePoints):
        self.cameras, self.points = cameras, points
        self.centers = np.array([camera.center for camera in cameras])
        self.distance = np.linalg.norm(points.position - points.center, axis=1)

    def is_level(self, plane: np.ndarray) -> bool:
        """Whether a plane (4,), or its normal (3,), is that of a floor, or of a table."""
        upward = -np.mean([camera.rotation[1] for camera in self.cameras], axis=0)
        return bool(plane[:3] @ upward > UPRIGHT * np.linalg.norm(upward))

    def facing(self, plane: np.ndarray) -> np.ndarray:
        """The plane with its normal towards the cameras."""
        return plane if (self.centers @ plane[:3]).mean() > plane[3] else -plane

    def is_enclosing(self, plane: np.ndarray, least: float = LEAST_SHARE) -> bool:
        """Whether at least a share `least` of the points lies on the plane, with normals alike, and hardly any behind
        it, but for a share SEEN_THROUGH in recesses."""
        on = self.points.on(plane[None], CONFIRMED_DEPTH)
        return (
            bool(on.any())
            and on.mean() >= least
            and self.is_before_all(plane, RECESS)
            and self.share_behind(plane, MARGIN) < SEEN_THROUGH
        )

    def is_before_all(self, plane: np.ndarray, margin: float = MARGIN) -> bool:
        """Whether all cameras are before a plane, and hardly any point is behind it by more than a share `margin` of
        its distance."""
        return self.share_behind(plane, margin) < OUTLIERS and bool((self.centers @ plane[:3] > plane[3]).all())

    def share_behind(self, plane: np.ndarray, margin: float) -> float:
        """The share of the points that are behind a plane by more than a share `margin` of their distance."""
        return float((self.height(plane) < -margin * self.distance).mean())

    def is_passed(self, wall: EnclosingPlane) -> bool:
        """Whether more than SEEN_THROUGH of the known points in the direction of a wall's own rectangle, but for a
        margin, are behind it."""
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
        """(P,) how far points are before a plane."""
        return self.points.position @ plane[:3] - plane[3]

    def on(self, plane: np.ndarray) -> np.ndarray:
        """(P,) bool which points are on a plane, whatever their normals, which are bent in corners."""
        return np.abs(self.height(plane)) < CONFIRMED_DEPTH * self.distance

    def without_copies(self, planes: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Planes in the order of how many points are on them, those with points in recesses last, each unless most of
        its points are on one before, too: a plane between a floor and a board above it has points of both."""
        kept: list[np.ndarray] = []
        for plane in sorted(planes, key=lambda plane: (not self.is_before_all(plane), -self.on(plane).sum())):
            own = self.on(plane)
            alike = [other for other in kept if plane[:3] @ other[:3] > SAME_NORMAL]
            near = (np.abs(self.height(other)[own]) < MARGIN * self.distance[own] for other in alike)
            if not any(share.mean() > 0.5 for share in near):
                kept.append(plane)
        return kept

    def which_is_there(self, plane: EnclosingPlane, others: Sequence[EnclosingPlane]) -> int | None:
        """The number of the first of others that faces the same way and on which the middle of a plane is."""
        middle = plane.at(plane.own.mean(0))[None]
        for number, other in enumerate(others):
            if plane.normal @ other.normal > SAME_NORMAL and self.are_on(middle, other):
                return number
        return None

    def are_on(self, places: np.ndarray, plane: EnclosingPlane) -> bool:
        """Whether (P, 3) places are on a plane, for a camera as far from them as the one in the middle by that."""
        near = self.margin_at(places.mean(0))
        return bool((np.abs(places @ plane.normal - plane.offset) < near).all())

    def margin_at(self, place: np.ndarray) -> float:
        """MARGIN of what is at a place (3,), for a camera as far from it as the one in the middle by that."""
        return MARGIN * float(np.median(np.linalg.norm(self.centers - place, axis=1)))

    def closing(self, found: Sequence[np.ndarray], every: KnownPoints) -> list[np.ndarray]:
        """Planes at right angles to two of those `found` where both end, by `every` point, too, on sides where there is
        none."""
        closing: list[np.ndarray] = []
        for number, first in enumerate(found):
            for second in (other for other in found[:number] if at_right_angles(first, other)):
                across = np.cross(first[:3], second[:3])
                across /= np.linalg.norm(across)
                sides = [self.on(plane) for plane in (first, second)]
                apart = MARGIN * min(np.median(self.distance[own]) for own in sides)
                for normal in (across, -across):
                    ends = [np.quantile(self.points.position[own] @ normal, OUTLIERS) for own in sides]
                    there = any(normal @ other[:3] > SAME_NORMAL for other in (*found, *closing))
                    plane = np.append(normal, np.mean(ends))
                    if there or abs(ends[0] - ends[1]) > ENDS_APART * apart or not every.is_before_all(plane):
                        continue
                    ending = all(every.ends_at(wall, plane, apart) for wall in (first, second))
                    if ending and all(self.ends_in_images(own, plane, apart) for own in sides):
                        closing.append(plane)
        return closing

    def ends_at(self, plane: np.ndarray, end: np.ndarray, near: float) -> bool:
        """Whether hardly any point of a plane is farther than `near` beyond its end at another plane."""
        return bool((self.height(end)[self.on(plane)] < -near).mean() < OUTLIERS)

    def ends_in_images(self, own: np.ndarray, end: np.ndarray, near: float) -> bool:
        """Whether most views of the points of a plane that are `near` its end at another plane show what lies beyond,
        so that it does not end where photographs do."""
        rows = np.flatnonzero(own & (self.height(end) < near))
        beyond = self.points.position[rows] - 2 * near * end[:3]
        views = self.points.view[rows]
        inside = [visible_pixels(self.cameras[view], beyond[views == view])[0] for view in np.unique(views)]
        return bool(np.concatenate(inside).mean() > 0.5)

    def with_ends(self, plane: np.ndarray, corners: Sequence[np.ndarray], own: np.ndarray | slice) -> EnclosingPlane:
        """A plane with its ends by its `own` points, along the normal of the first of the `corners` that is at right
        angles to it, or else along the sides of the smallest rectangle. Without another one it ends with its points."""
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
        """Axes and ends of the rectangle in a plane that holds its `own` points on the least area."""
        one, other = _axes(plane[:3], np.eye(3)[np.abs(plane[:3]).argmin()])
        points, tried = self.points.position[own], []
        for angle in np.linspace(0, np.pi / 2, DIRECTIONS, endpoint=False):
            axes = np.cos(angle) * np.stack([one, other]) + np.sin(angle) * np.stack([other, -one])
            ends = _ends(points @ axes.T)
            tried.append((float(np.diff(ends, axis=0).prod()), axes, ends))
        _, axes, ends = min(tried, key=lambda each: each[0])
        return axes, ends

    def is_filled(self, plane: np.ndarray, own: np.ndarray) -> bool:
        """Whether a plane's `own` points are all over it."""
        axes, ends = self.smallest_rectangle(plane, own)
        along = (self.points.position[own] @ axes.T - ends[0]) / np.diff(ends, axis=0)
        cells = np.floor(CELLS * along[(along >= 0).all(1) & (along < 1).all(1)]).astype(int)
        return len(np.unique(cells, axis=0)) >= FILLED * CELLS**2


def _axes(normal: np.ndarray, near: np.ndarray) -> np.ndarray:
    """(2, 3) unit vectors at right angles to a `normal` and to each other, the first as `near` to another as can
    be."""
    first = near - normal * (near @ normal)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


def _ends(along: np.ndarray) -> np.ndarray:
    """(2, 2) least and greatest of (P, 2) coordinates."""
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
    """(H, W) float32 depth of every view at its `wanted` pixels where their rays end at an enclosing plane, else NaN.

    Args:
        known: (H, W) depth of every view, NaN where nothing is known.
        wanted: (H, W) bool.
        shown: (H, W) depth of every view that a pixel probably has, NaN where none is more probable than others: a
            plane has to be near it.
        doubtful: (H, W) depth of every view that is on a plane if it is near one, NaN where there is none; elsewhere a
            place that MOST_KNOW is not what a pixel shows of which nothing is known.
    """
    result = [np.full(depth.shape, np.nan, np.float32) for depth in known]
    for camera, depth, pixels, probable, supposed in zip(cameras, result, wanted, shown, doubtful, strict=True):
        row, column = np.nonzero(pixels)
        if not len(row) or not enclosing:
            continue
        rays = rays_of(camera, row, column)
        nearest, own, whole = _first_met(camera, rays, enclosing)
        elsewhere = np.abs(probable[row, column] * nearest - 1) > MARGIN  # not where it is NaN
        rows = np.flatnonzero((own | whole) & ~elsewhere)
        looking, knowing = _looking(to_world(camera, rays[rows] / nearest[rows, None]), cameras, known)
        on_it = np.abs(supposed[row[rows], column[rows]] * nearest[rows] - 1) <= ON_IT
        rows = rows[(own[rows] | (looking <= FEW_VIEWS)) & (on_it | (knowing <= MOST_KNOW * looking))]
        depth[row[rows], column[rows]] = 1 / nearest[rows]
    return result


def _first_met(
    camera: Camera, rays: np.ndarray, enclosing: Sequence[EnclosingPlane]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(N,) inverse depth of the first enclosing plane that each of (N, 3) rays of a camera meets, not positive where it
    meets none, and (N,) bool whether that is within the rectangle of its own points, and within that of all."""
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
    """(H, W) float32 depth where rays end at enclosing planes, in those plain regions of a view that lie on these, NaN
    elsewhere: a thing before a wall has an edge.

    Of what is `known` (H, W) within a region, NaN elsewhere, AGREEING is on the planes, and it is more than chance. As
    edges may have gaps, only pixels lie on planes whose nearest known one does.
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
    """(H, W) bool of every view: where a `known` (H, W) depth, NaN where there is none, lies on an enclosing plane
    within the rectangle of its own points, and hardly any view looks there, but most of these know it."""
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
    """(N,) how many views look at (N, 3) points, which are in their images with nothing known before, and (N,) how many
    of these know a depth there."""
    depths = (np.ascontiguousarray(depth, np.float32) for depth in known)
    views = [(*camera.pinhole(), depth) for camera, depth in zip(cameras, depths, strict=True)]
    return surface_ops.count_looking_views(views, np.ascontiguousarray(points), MARGIN)
