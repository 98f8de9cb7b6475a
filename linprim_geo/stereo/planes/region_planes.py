"""Which of several planes plain regions lie on: by what is known along their edges.

A wall that a region shows has points along the region's edges, where it meets other walls and where things hang on it;
the others are those of occluders. Planes that happen to go through occluders have fewer, and those through the line in
which two walls meet have points of both, but hold little of the region. Only points on a region's own side of its edges
count: beside a thing before a wall the others are on the wall. A plane is believed within the convex hull of its points
alone: beyond, walls end. One through the edges of several occluders hangs in the air, and photographs that see what is
behind it refuse it, or that show different colours of what is behind it: the plane of balusters in the gaps between
them.

Beside an edge stereo sees nothing but the edge, and its depth goes on into the region. There the plane is right, if the
region is wide enough to tell; where a thing that no edge parts from the wall is before it, stereo is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile

import numpy as np
from scipy.ndimage import distance_transform_edt, label, uniform_filter
from scipy.spatial import ConvexHull, QhullError

from linprim_geo.geometry.camera import Camera
from linprim_geo.stereo.planes.enclosing_planes import SURE_SHARE
from linprim_geo.stereo.planes.plain_regions import (
    BEHIND,
    BEHIND_SHARE,
    LEAST_POINTS,
    RING,
    TOLERANCE,
    WIDE,
    PlainRegion,
    in_camera,
    may_lie_on,
    rays_of,
    to_world,
)
from linprim_geo.stereo.planes.point_planes import CENTRAL_SHARE
from linprim_geo.stereo.planes.seen_through import KnownDepths
from linprim_geo.stereo.planes.shown_colours import ShownColours

# Of what stereo is sure of within a region so much is on its plane, if it is sure of enough.
MOST_AGREE = 0.5
# What stereo is sure of on a true plane is off by so much of the depth in the median, at most: the least of
# `point_planes.TOLERANCES`.
MEDIAN_OFF = TOLERANCE / 4
# Stereo gives the depth of an edge to pixels so far beside it; regions go on to the middle of edges (`grown_alike`).
EDGE_REACH = WIDE // 2 + RING
# Of a region so many pixels, or up to twice as many, tell how much of it a plane's hull holds.
SAMPLES = 1000
# The side of the square around a pixel in which what is off its plane is a surface of its own if it is most of it, and
# in which a plane is shown by confirmed depths on it on this share of what is laid.
SURROUNDINGS, SHOWN = 2 * WIDE + 1, 0.1
# Photographs refuse a plane by their colours if so many of a region's points are on it: before others there may be
# things that hide it.
MOSTLY_ON = 0.7
# Of one region, by the numbers of the planes that it may lie on: which of its N points are on it (N,) bool.
_Lying = dict[int, np.ndarray]


@dataclass(frozen=True)
class RegionDepths:
    """On which plane each pixel of a view's plain regions lies: its `number` (H, W), -1 elsewhere, and float32 `depth`
    (H, W), NaN elsewhere; (H, W) bool where a known depth is that of the plane but for its error, so that it is to be
    `moved` to it, where the plane `stands` against any other depth, and where it is `doubted`, as nothing confirms it
    although stereo knows the rest of the region; and planes (3,) of the camera that are `refused` in regions which
    stereo does not know, as photographs show different colours there."""

    number: np.ndarray
    depth: np.ndarray
    moved: np.ndarray
    stands: np.ndarray
    doubted: np.ndarray
    refused: list[tuple[PlainRegion, np.ndarray]]

    @classmethod
    def nothing(cls, camera: Camera) -> RegionDepths:
        """Of a view before any plane is laid."""
        shape = (camera.height, camera.width)
        moved, stands, doubted = (np.zeros(shape, bool) for _ in range(3))
        return cls(np.full(shape, -1, np.int32), np.full(shape, np.nan, np.float32), moved, stands, doubted, [])

    def refuses(self, camera: Camera, depth: np.ndarray) -> np.ndarray:
        """(H, W) bool: which depths of the view, NaN where unknown, are those of planes that are `refused` there."""
        result = np.zeros(depth.shape, bool)
        for region, plane in self.refused:
            row, column = region.pixels()
            off = depth[row, column] * (rays_of(camera, row, column) @ plane) - 1
            result[row, column] |= np.abs(off) < BEHIND * TOLERANCE
        return result

    def without(self, taken: np.ndarray) -> RegionDepths:
        """Nothing where pixels are `taken` (H, W)."""
        return RegionDepths(
            np.where(taken, np.int32(-1), self.number),
            np.where(taken, np.float32(np.nan), self.depth),
            self.moved & ~taken,
            self.stands & ~taken,
            self.doubted & ~taken,
            self.refused,
        )


def region_plane_depths(
    cameras: Sequence[Camera],
    regions: Sequence[Sequence[PlainRegion]],
    planes: np.ndarray,
    known: Sequence[np.ndarray],
    confirmed: Sequence[np.ndarray],
    colours: ShownColours,
) -> list[RegionDepths]:
    """Of each view, of its plain `regions` by the (K, 4) planes of the world on which they lie, with the `known` (H, W)
    depths and all that are `confirmed` (H, W), NaN elsewhere, and the `colours` that views show.

    A pixel lies on the plane with the most points along the edges of its region, which count more the nearer they are
    (Tukey's weight), times what its hull holds of it, of those within whose hull it is and on which most known depths
    there are. Stereo errs beside edges: in what is wide of a region the plane stands, but for what is known of surfaces
    of their own. A known depth within TOLERANCE of a plane has its depth if all of these in the region are off by
    MEDIAN_OFF in the median at most, and CENTRAL_SHARE of them are within half of TOLERANCE: across a curved surface a
    half is. Nothing is laid where most of it has confirmed depths off its plane in the SURROUNDINGS: a thing in front
    that no edge parts from the plane. Of a region of which stereo knows most what has no confirmed depth on the plane
    around is doubted. On a plane on which most photographs show other colours of a narrow region nothing is laid.
    """
    local = [in_camera(camera, planes) for camera in cameras]
    regions = [[region.within() for region in own] for own in regions]
    lying = [[_lying(region, of_view) for region in own] for own, of_view in zip(regions, local, strict=True)]
    hulls = _hulls(cameras, regions, lying, planes)
    beside = [beside_edges(depth.shape, own) for depth, own in zip(known, regions, strict=True)]
    views = KnownDepths(cameras, (np.where(at, np.nan, depth) for at, depth in zip(beside, known, strict=True)))
    result = []
    of_views = zip(cameras, regions, lying, local, known, confirmed, beside, strict=True)
    for camera, own, of_regions, of_view, sure, seen, of_edges in of_views:
        laid = RegionDepths.nothing(camera)
        wide, telling = np.zeros_like(laid.moved), np.where(of_edges, np.nan, sure)
        for region, on in zip(own, of_regions, strict=True):
            counts = {number: _tukey_sum(region.off(of_view[[number]])[points, 0]) for number, points in on.items()}
            best = _best_first(camera, region, of_view, hulls, counts, views)
            refused = [] if _is_well_known(sure, region) else _refused(region, on, best, planes, colours)
            laid.refused.extend((region, of_view[number]) for number in refused)
            _lay(laid, camera, region, of_view, [*best][len(refused) :], hulls, sure, telling)
            height, width = region.wide.shape
            wide[region.top : region.top + height, region.left : region.left + width] |= region.wide
        seen = np.where(of_edges, np.nan, seen)
        result.append(_limited(laid, wide, sure, seen, _well_known(sure, own)))
    return result


def _lying(region: PlainRegion, planes: np.ndarray) -> _Lying:
    """On which of (K, 3) planes of the camera a region may lie."""
    on, fits = may_lie_on(region, planes)
    return {number: on[:, number].copy() for number in np.flatnonzero(fits).tolist()}


def _tukey_sum(off: np.ndarray) -> float:
    """Tukey's weights of (N,) points that are `off` a plane by less than TOLERANCE, added up."""
    return float(((1 - (off / TOLERANCE) ** 2) ** 2).sum())


def _limited(
    laid: RegionDepths, wide: np.ndarray, sure: np.ndarray, confirmed: np.ndarray, well_known: np.ndarray
) -> RegionDepths:
    """What is laid on planes, by what stereo is `sure` of and has `confirmed` (H, W), NaN elsewhere: moved to planes
    that stand in what is `wide` (H, W), doubted in what is `well_known` (H, W), and nothing where most is off."""
    is_laid = np.isfinite(laid.depth)
    of_all = _around(is_laid)
    of_sure, of_confirmed = (depth / laid.depth - 1 for depth in (sure, confirmed))
    off, confirmed_off = np.abs(of_sure) > TOLERANCE, np.abs(of_confirmed) > TOLERANCE  # not where it is NaN
    stands = is_laid & wide & ~_are_surfaces(off, of_all)
    doubted = is_laid & well_known & (_around(np.abs(of_confirmed) <= TOLERANCE) <= SHOWN * of_all)
    laid = replace(laid, moved=laid.moved | (off & stands), stands=stands, doubted=doubted)
    return laid.without(_around(confirmed_off) > of_all / 2)


def _are_surfaces(off: np.ndarray, of_all: np.ndarray) -> np.ndarray:
    """(H, W) bool: which depths that are `off` (H, W) the planes are surfaces of their own, and no bands along edges:
    pieces of which most have most of what is laid in their SURROUNDINGS (`of_all`, its share) off its plane, too."""
    surrounded = off & (_around(off) > of_all / 2)
    piece, count = label(off, np.ones((3, 3)))
    sizes, inner = (np.bincount(piece[part], minlength=count + 1) for part in (off, surrounded))
    return off & (inner > sizes / 2)[piece]


def _around(part: np.ndarray) -> np.ndarray:
    """(H, W) float32 share of a `part` (H, W) bool in the SURROUNDINGS."""
    return uniform_filter(part.astype(np.float32), SURROUNDINGS)


def _well_known(sure: np.ndarray, regions: Sequence[PlainRegion]) -> np.ndarray:
    """(H, W) bool: the regions of which stereo is `sure` (H, W) of more than half, so that they are not plain."""
    result = np.zeros(sure.shape, bool)
    for region in regions:
        if _is_well_known(sure, region):
            result[region.pixels()] = True
    return result


def _is_well_known(sure: np.ndarray, region: PlainRegion) -> bool:
    """Whether stereo is `sure` (H, W) of more than half of a region."""
    return bool(np.isfinite(sure[region.pixels()]).mean() > 0.5)


def _best_first(
    camera: Camera,
    region: PlainRegion,
    planes: np.ndarray,
    hulls: Sequence[_Hull],
    counts: Mapping[int, float],
    views: KnownDepths,
) -> dict[int, np.ndarray]:
    """Of those (K, 3) planes of the camera that views do not see through in the region, by their numbers: (P, 3) points
    of the region within the plane's hull; first of the one with the most of `counts` of points along its edges, times
    what its hull holds of the region."""
    rays, held = _sampled_rays(camera, region), dict[int, np.ndarray]()
    for number in counts:
        inverse = rays @ planes[number]
        rows = _held(camera, rays, inverse, hulls[number])
        points = to_world(camera, rays[rows] / inverse[rows, None])
        if len(rows) and np.count_nonzero(views.see_through(points)) <= BEHIND_SHARE * len(rows):
            held[number] = points
    order = sorted(held, key=lambda number: -counts[number] * len(held[number]))
    return {number: held[number] for number in order}


def _refused(
    region: PlainRegion, on: _Lying, held: Mapping[int, np.ndarray], planes: np.ndarray, colours: ShownColours
) -> list[int]:
    """The numbers of the first of those (K, 4) planes of the world that most of a region's (N,) points are `on`, and on
    which photographs show different colours of what is `held` (P, 3) of the region: of a narrow one, as a wide
    one, such as a door, may shine."""
    if region.wide.any():
        return []

    def is_refused(number: int) -> bool:
        return on[number].mean() > MOSTLY_ON and colours.differ(region.view, held[number], planes[number, :3])

    return list(takewhile(is_refused, held))


def beside_edges(shape: tuple[int, int], regions: Sequence[PlainRegion]) -> np.ndarray:
    """(H, W) bool: pixels of a view's plain regions that may have the depth of an edge beside them, in regions of which
    most is wide: of others these are all that tells."""
    result = np.zeros(shape, bool)
    for region in regions:
        if np.count_nonzero(region.wide) > np.count_nonzero(region.mask) / 2:
            beside = region.mask & (distance_transform_edt(np.pad(region.mask, 1))[1:-1, 1:-1] <= EDGE_REACH)
            row, column = np.nonzero(beside)
            result[row + region.top, column + region.left] = True
    return result


def _sampled_rays(camera: Camera, region: PlainRegion) -> np.ndarray:
    """(P, 3) rays of depth 1 of about SAMPLES pixels of a region, evenly taken."""
    row, column = region.pixels()
    step = max(1, len(row) // SAMPLES)
    return rays_of(camera, row[::step], column[::step])


def _held(camera: Camera, rays: np.ndarray, inverse: np.ndarray, hull: _Hull) -> np.ndarray:
    """The numbers of (P, 3) rays that end within a plane's hull, by their `inverse` (P,) depths."""
    before = np.flatnonzero(inverse > 0)
    return before[hull.holds(to_world(camera, rays[before] / inverse[before, None]))]


def _hulls(
    cameras: Sequence[Camera],
    regions: Sequence[Sequence[PlainRegion]],
    lying: Sequence[Sequence[_Lying]],
    planes: np.ndarray,
) -> list[_Hull]:
    """Of each plane, around its points along the edges of regions of all views that may lie on it."""
    points = [[np.zeros((0, 3))] for _ in planes]
    for camera, own, of_regions in zip(cameras, regions, lying, strict=True):
        for region, of_region in zip(own, of_regions, strict=True):
            places = to_world(camera, region.rays / region.inverse[:, None])
            for number, on in of_region.items():
                points[number].append(places[on])
    return [_Hull(plane, np.concatenate(parts)) for plane, parts in zip(planes, points, strict=True)]


def _lay(
    laid: RegionDepths,
    camera: Camera,
    region: PlainRegion,
    planes: np.ndarray,
    best: Sequence[int],
    hulls: Sequence[_Hull],
    known: np.ndarray,
    telling: np.ndarray,
) -> None:
    """Lays each pixel of a region on the first of the `best` of (K, 3) planes of the camera whose hull it is in and on
    which most (H, W) `telling` depths are there, and says where `known` (H, W) ones are moved to it."""
    row, column = region.pixels()
    rays, left = rays_of(camera, row, column), np.ones(len(row), bool)
    for number in best:
        inverse = np.where(left, rays @ planes[number], 0)
        rows = _held(camera, rays, inverse, hulls[number])
        off = known[row[rows], column[rows]] * inverse[rows] - 1
        told = telling[row[rows], column[rows]] * inverse[rows] - 1
        count = np.count_nonzero(np.isfinite(told))
        enough = count >= max(LEAST_POINTS, SURE_SHARE * len(rows))
        if not enough or np.count_nonzero(np.abs(told) < BEHIND * TOLERANCE) >= MOST_AGREE * count:
            laid.number[row[rows], column[rows]] = number
            laid.depth[row[rows], column[rows]] = 1 / inverse[rows]
            left[rows] = False
            on = np.flatnonzero(np.abs(off) < TOLERANCE)
            central = np.count_nonzero(np.abs(off[on]) < TOLERANCE / 2)
            flat = len(on) >= LEAST_POINTS and central >= CENTRAL_SHARE * len(on)
            if flat and abs(np.median(off[on])) <= MEDIAN_OFF:
                laid.moved[row[rows[on]], column[rows[on]]] = True


class _Hull:
    """The convex hull of (P, 3) points on a plane (4,); it holds nothing if all of them are on one line."""

    def __init__(self, plane: np.ndarray, points: np.ndarray):
        self.axes = np.linalg.svd(plane[None, :3])[2][1:]
        try:
            self.sides = ConvexHull(points @ self.axes.T).equations
        except (QhullError, ValueError):  # on one line, or fewer than three
            self.sides = np.array([[0.0, 0.0, 1.0]])

    def holds(self, places: np.ndarray) -> np.ndarray:
        """(P,) whether (P, 3) places on the plane are within the hull."""
        along = places @ self.axes.T
        inside = np.ones(len(places), bool)
        for x, y, offset in self.sides:
            inside &= x * along[:, 0] + y * along[:, 1] + offset <= 0
        return inside
