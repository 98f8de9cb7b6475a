"""Assign plain regions of each view to planes, by the depths along their edges.

A region lies on a plane if enough points on its own side of its edges are inliers; points of occluders are outliers. A
plane holds only within the convex hull of its inliers, as walls end somewhere. Two kinds of false planes are rejected:
those that other views see through, as the plane through the edges of several occluders; and those on which photographs
show different colours, as the plane of balusters does in the gaps between them. Beside an edge, stereo extends the
edge's depth into the region. There the plane replaces it if the region is wide, unless the depths form a surface of
their own: an object in front of the wall without an edge between the two.
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
from linprim_geo.stereo.planes.seen_through import FreeSpaceTest
from linprim_geo.stereo.planes.shown_colours import ShownColours

# A plane is laid over part of a region if at least this share of the sure depths there agree with it; fewer sure depths
# than chance gives are ignored.
MOST_AGREE = 0.5
# Sure depths on a true plane have a median residual of at most this share of the depth: the least of
# `point_planes.TOLERANCES`.
MEDIAN_OFF = TOLERANCE / 4
# Within so many pixels of a region's border stereo may give the depth of the edge; regions extend to the middle of
# edges (`grown_alike`).
EDGE_REACH = WIDE // 2 + RING
# About so many pixels of a region, or up to twice as many, are sampled to estimate how much of it is in a plane's hull.
SAMPLES = 1000
# The side in pixels of the square around a pixel in which depths are compared with the plane: most of them off the
# plane form a surface of their own; the plane is confirmed there if confirmed inliers exceed the share SHOWN of what is
# laid.
SURROUNDINGS, SHOWN = 2 * WIDE + 1, 0.1
# The colour test rejects a plane only if more than this share of the region's points are inliers. On other planes,
# objects in front of the plane may explain the colours.
MOSTLY_ON = 0.7
# For one region: the numbers of the planes that it may lie on, each with (N,) bool, which of its N points are inliers.
_Lying = dict[int, np.ndarray]


@dataclass(frozen=True)
class RegionDepths:
    """The planes assigned to the pixels of a view's plain regions.

    `number` (H, W) of the plane, -1 where none; `depth` (H, W) float32 of the plane, NaN where none. (H, W) bool:
    `moved` where a known depth differs from the plane by no more than its error and is replaced by it; `stands` where
    the plane overrides any other depth; `doubted` where nothing confirms the plane although stereo knows most of the
    region. `refused` lists regions that stereo does not know, each with a plane (3,) of the camera that the colour test
    rejected.
    """

    number: np.ndarray
    depth: np.ndarray
    moved: np.ndarray
    stands: np.ndarray
    doubted: np.ndarray
    refused: list[tuple[PlainRegion, np.ndarray]]

    @classmethod
    def nothing(cls, camera: Camera) -> RegionDepths:
        """Return one for a view without any planes yet."""
        shape = (camera.height, camera.width)
        moved, stands, doubted = (np.zeros(shape, bool) for _ in range(3))
        return cls(np.full(shape, -1, np.int32), np.full(shape, np.nan, np.float32), moved, stands, doubted, [])

    def refuses(self, camera: Camera, depth: np.ndarray) -> np.ndarray:
        """Return (H, W) bool: which depths (H, W), NaN where unknown, lie on planes that are `refused` in their
        region."""
        result = np.zeros(depth.shape, bool)
        for region, plane in self.refused:
            row, column = region.pixels()
            off = depth[row, column] * (rays_of(camera, row, column) @ plane) - 1
            result[row, column] |= np.abs(off) < BEHIND * TOLERANCE
        return result

    def without(self, taken: np.ndarray) -> RegionDepths:
        """Return a copy without the pixels that are `taken` (H, W)."""
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
    """Assign the plain `regions` of every view to the (K, 4) planes of the world.

    Of the planes whose hull holds a pixel and with which most sure depths agree, the pixel gets the one with the
    highest score: the sum of Tukey's weights of the region's inliers, times the number of sampled pixels within its
    hull. Planes that other views see through are left out. In narrow regions that stereo does not know, planes on which
    most photographs show other colours are refused. In the wide part of a region the plane overrides depths of stereo,
    except surfaces of their own. Sure depths within TOLERANCE are moved to it, if their median residual is at most
    MEDIAN_OFF and CENTRAL_SHARE of them are within half of TOLERANCE (on a curved surface, half are). Pixels are left
    out where confirmed depths off the plane fill more than half of those laid in the SURROUNDINGS: an object in front
    of it without an edge in between. In regions that stereo mostly knows, pixels without confirmed inliers around are
    doubted.

    Args:
        known: (H, W) sure depths of every view, NaN elsewhere.
        confirmed: (H, W) all confirmed depths of every view, NaN elsewhere.
        colours: compares the colours of photographs.
    """
    local = [in_camera(camera, planes) for camera in cameras]
    regions = [[region.within() for region in own] for own in regions]
    lying = [[_lying(region, of_view) for region in own] for own, of_view in zip(regions, local, strict=True)]
    hulls = _hulls(cameras, regions, lying, planes)
    beside = [beside_edges(depth.shape, own) for depth, own in zip(known, regions, strict=True)]
    views = FreeSpaceTest(cameras, (np.where(at, np.nan, depth) for at, depth in zip(beside, known, strict=True)))
    result = []
    of_views = zip(cameras, regions, lying, local, known, confirmed, beside, strict=True)
    for camera, own, of_regions, of_view, sure, seen, of_edges in of_views:
        laid = RegionDepths.nothing(camera)
        wide, telling = np.zeros_like(laid.moved), np.where(of_edges, np.nan, sure)
        for region, on in zip(own, of_regions, strict=True):
            counts = {
                number: _tukey_sum(region.residuals(of_view[[number]])[points, 0]) for number, points in on.items()
            }
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
    """Return which of (K, 3) planes of the camera the region may lie on, with its inliers."""
    on, fits = may_lie_on(region, planes)
    return {number: on[:, number].copy() for number in np.flatnonzero(fits).tolist()}


def _tukey_sum(off: np.ndarray) -> float:
    """Return the sum of Tukey's biweights of (N,) residuals, which are below TOLERANCE."""
    return float(((1 - (off / TOLERANCE) ** 2) ** 2).sum())


def _limited(
    laid: RegionDepths, wide: np.ndarray, sure: np.ndarray, confirmed: np.ndarray, well_known: np.ndarray
) -> RegionDepths:
    """Apply the depths that stereo is `sure` of or has `confirmed` (H, W), NaN elsewhere, to the laid planes: they
    stand in the `wide` part (H, W), are doubted in `well_known` regions (H, W), and are removed where confirmed depths
    off them fill more than half of the laid pixels around."""
    is_laid = np.isfinite(laid.depth)
    of_all = _around(is_laid)
    of_sure, of_confirmed = (depth / laid.depth - 1 for depth in (sure, confirmed))
    off, confirmed_off = np.abs(of_sure) > TOLERANCE, np.abs(of_confirmed) > TOLERANCE  # false for NaN
    stands = is_laid & wide & ~_are_surfaces(off, of_all)
    doubted = is_laid & well_known & (_around(np.abs(of_confirmed) <= TOLERANCE) <= SHOWN * of_all)
    laid = replace(laid, moved=laid.moved | (off & stands), stands=stands, doubted=doubted)
    return laid.without(_around(confirmed_off) > of_all / 2)


def _are_surfaces(off: np.ndarray, of_all: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: which pixels `off` (H, W) their plane belong to surfaces of their own, not to bands along
    edges. They are connected components of which most pixels have more than half of the laid share around, `of_all`,
    off the plane."""
    surrounded = off & (_around(off) > of_all / 2)
    piece, count = label(off, np.ones((3, 3)))
    sizes, inner = (np.bincount(piece[part], minlength=count + 1) for part in (off, surrounded))
    return off & (inner > sizes / 2)[piece]


def _around(part: np.ndarray) -> np.ndarray:
    """Return the (H, W) float32 share of true pixels of `part` (H, W) in the SURROUNDINGS."""
    return uniform_filter(part.astype(np.float32), SURROUNDINGS)


def _well_known(sure: np.ndarray, regions: Sequence[PlainRegion]) -> np.ndarray:
    """Return (H, W) bool: the pixels of regions of which stereo is `sure` (H, W) of more than half, and which are thus
    not plain."""
    result = np.zeros(sure.shape, bool)
    for region in regions:
        if _is_well_known(sure, region):
            result[region.pixels()] = True
    return result


def _is_well_known(sure: np.ndarray, region: PlainRegion) -> bool:
    """Return whether stereo is `sure` (H, W) of more than half of the region's pixels."""
    return bool(np.isfinite(sure[region.pixels()]).mean() > 0.5)


def _best_first(
    camera: Camera,
    region: PlainRegion,
    planes: np.ndarray,
    hulls: Sequence[_Hull],
    counts: Mapping[int, float],
    views: FreeSpaceTest,
) -> dict[int, np.ndarray]:
    """Return those (K, 3) planes of the camera that other views do not see through, as a dict from their numbers to the
    (P, 3) sampled points of the region within the plane's hull. They are sorted by descending score: their `counts`,
    sums of weights of inliers, times P. A plane through the line in which two walls meet has inliers on both, but holds
    little of the region in its hull."""
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
    """Return the numbers of the leading (K, 4) planes of the world that the colour test rejects: more than MOSTLY_ON of
    the region's points are `on` them, and photographs show different colours at the `held` (P, 3) points. Only narrow
    regions are tested, as a wide one, such as a door, may be glossy."""
    if region.wide.any():
        return []

    def is_refused(number: int) -> bool:
        return on[number].mean() > MOSTLY_ON and colours.differ(region.view, held[number], planes[number, :3])

    return list(takewhile(is_refused, held))


def beside_edges(shape: tuple[int, int], regions: Sequence[PlainRegion]) -> np.ndarray:
    """Return (H, W) bool: pixels of a view's plain regions that may have the depth of a nearby edge. Only regions that
    are wide for the most part are marked; others would have no depths left."""
    result = np.zeros(shape, bool)
    for region in regions:
        if np.count_nonzero(region.wide) > np.count_nonzero(region.mask) / 2:
            beside = region.mask & (distance_transform_edt(np.pad(region.mask, 1))[1:-1, 1:-1] <= EDGE_REACH)
            row, column = np.nonzero(beside)
            result[row + region.top, column + region.left] = True
    return result


def _sampled_rays(camera: Camera, region: PlainRegion) -> np.ndarray:
    """Return (P, 3) rays of depth 1 through about SAMPLES pixels of the region, evenly spaced."""
    row, column = region.pixels()
    step = max(1, len(row) // SAMPLES)
    return rays_of(camera, row[::step], column[::step])


def _held(camera: Camera, rays: np.ndarray, inverse: np.ndarray, hull: _Hull) -> np.ndarray:
    """Return the indices of those (P, 3) rays that meet the plane within its hull, given their `inverse` (P,) depths on
    it."""
    before = np.flatnonzero(inverse > 0)
    return before[hull.holds(to_world(camera, rays[before] / inverse[before, None]))]


def _hulls(
    cameras: Sequence[Camera],
    regions: Sequence[Sequence[PlainRegion]],
    lying: Sequence[Sequence[_Lying]],
    planes: np.ndarray,
) -> list[_Hull]:
    """Return the hull of each plane, around its inliers along the edges of all regions of all views that may lie on
    it."""
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
    """Assign each pixel of a region, in place, to the first of the `best` (K, 3) planes of the camera that holds it in
    its hull and with which most of the `telling` (H, W) depths agree. Mark where `known` (H, W) depths are moved to the
    plane."""
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
    """The convex hull of (P, 3) points on a plane (4,); empty if all points are on one line."""

    def __init__(self, plane: np.ndarray, points: np.ndarray):
        self.axes = np.linalg.svd(plane[None, :3])[2][1:]
        try:
            self.sides = ConvexHull(points @ self.axes.T).equations
        except (QhullError, ValueError):  # on one line, or fewer than three
            self.sides = np.array([[0.0, 0.0, 1.0]])

    def holds(self, places: np.ndarray) -> np.ndarray:
        """Return (P,) bool: which of (P, 3) points on the plane are within the hull."""
        along = places @ self.axes.T
        inside = np.ones(len(places), bool)
        for x, y, offset in self.sides:
            inside &= x * along[:, 0] + y * along[:, 1] + offset <= 0
        return inside
