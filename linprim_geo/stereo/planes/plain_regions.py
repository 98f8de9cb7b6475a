"""Planes for regions without texture, such as painted walls.

Stereo sees the edges of a plain region and not what is inside. Planes are fitted to the confirmed depths along its
edges, of which those of occluders lie before it and none behind it. Planes are those that several views find from
directions that differ: a silhouette of something round gives another plane to each view, and so none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt, find_objects, label, uniform_filter

from linprim_geo.geometry.camera import Camera
from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.evidence import CONFIRMED_DEPTH

# Regions have at least so many pixels (two windows of stereo) and so many confirmed depths within RING pixels.
LEAST_PIXELS, LEAST_POINTS, RING = 200, 30, 4
# Stereo gives the depth of an edge to pixels up to ten beside it (DECISIONS 126): what has no edge within twice as many
# is plain beyond doubt.
WIDE = 20
# Half of the grey values by which a cross parts two pixels (`csrc/stereo/cross.h`), and the side of the square
# over which the grey of a region is taken.
HALF_EDGE, AROUND = 12.5, 9
# Stereo knows six in ten edges of a far background as farther than so many times the median depth, and of surfaces one
# in 3,000 (DECISIONS 90).
BEYOND = 10.0
# Depths are on a plane up to this share of them, and behind it from BEHIND times as much.
TOLERANCE, BEHIND = CONFIRMED_DEPTH, 3.0
# At least and at most such shares of a region's confirmed depths are on its plane, and behind it.
ON_SHARE, BEHIND_SHARE = 0.1, 0.1
# Triples of points that are tried for a plane, planes that are looked for, and fits of each to what is on it.
TRIPLES, PLANES_PER_REGION, FITS = 300, 4, 3
# Points along an edge have common errors: they count as so many independent ones at most.
INDEPENDENT_POINTS = 20
# A plane is one that so many views find, of which two see it from directions that differ by SPREAD.
LEAST_VIEWS, SPREAD = 3, np.radians(10)
# Fewer degrees are enough, but for LEAST_SPREAD, where the normals that views find turn by half as much as those of
# silhouettes do: over a turn by t these have a standard deviation of t / sqrt 12.
STEADY, LEAST_SPREAD = 2 * np.sqrt(12), np.radians(6)
# Planes are the same if their normals differ by no more, and their distance by no more than TOLERANCE of the depth.
SAME_ANGLE = np.radians(3)
# A plane is as certain as its points scatter if they are more than this share of all points of its regions: of fewer,
# those near the plane were chosen, and their scatter is that of the choice.
ALL_POINTS = 0.9
# Rounds in which planes are chosen by regions and fitted to all points on them.
ROUNDS = 3


@dataclass(frozen=True)
class PlainRegion:
    """A region of view `view` without texture: `mask` (`grown_alike`) of a window whose first pixel is (`top`, `left`);
    along its edges `rays` (N, 3) of depth 1 and `inverse` (N,) depths, of which those that are not `sure` (N,) are far
    and on no plane, and those that are `inner` (N,) within the mask; `corners` (5, 3) rays to its ends and its
    middle; `wide` of the mask what circles of WIDE pixels without an edge cover, and the edges beside these."""

    view: int
    top: int
    left: int
    mask: np.ndarray
    rays: np.ndarray
    inverse: np.ndarray
    sure: np.ndarray
    inner: np.ndarray
    corners: np.ndarray
    wide: np.ndarray

    def pixels(self) -> tuple[np.ndarray, np.ndarray]:
        """(P,) rows and columns of its mask in the image."""
        row, column = np.nonzero(self.mask)
        return row + self.top, column + self.left

    def within(self) -> PlainRegion:
        """The region with its inner points alone."""
        return replace(
            self,
            rays=self.rays[self.inner],
            inverse=self.inverse[self.inner],
            sure=self.sure[self.inner],
            inner=self.inner[self.inner],
        )

    def off(self, planes: np.ndarray) -> np.ndarray:
        """(N, K) by what share of their inverse depth (K, 3) planes are before the edges' points."""
        return (self.rays @ planes.T) / self.inverse[:, None] - 1

    def are_on(self, off: np.ndarray) -> np.ndarray:
        """(N, K) bool which points are on planes, by what these are `off`."""
        return (np.abs(off) < TOLERANCE) & self.sure[:, None]


def grown_alike(region: np.ndarray, grey: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """(H, W) bool: of a plain region what no `edge` runs through, and of edges what is no farther from that than RING
    pixels and of the same grey, up to HALF_EDGE: blur mixes pixels on an edge out of both sides."""
    inside = region & ~edge
    if not inside.any():
        return inside
    share = uniform_filter(inside.astype(np.float64), AROUND)
    mean = uniform_filter(np.where(inside, grey, 0.0), AROUND) / np.maximum(share, 1e-9)
    distance, nearest = distance_transform_edt(~inside, return_indices=True)
    return inside | (edge & (distance <= RING) & (np.abs(grey - mean[tuple(nearest)]) < HALF_EDGE))


def plain_regions(
    view: int, camera: Camera, grey: np.ndarray, edge: np.ndarray, depth: np.ndarray, sure: np.ndarray
) -> list[PlainRegion]:
    """Regions of (H, W) `grey` between edges; `depth` (H, W) is NaN where it is not known, and `sure` (H, W) where it
    is no far one that may be wrong."""
    labels, _ = label(~edge)
    from_edge = distance_transform_edt(~edge)
    points, regions = np.isfinite(depth) & edge, []
    for number, (rows, columns) in enumerate(find_objects(labels), start=1):
        top, left = max(rows.start - RING, 0), max(columns.start - RING, 0)
        window = np.s_[top : rows.stop + RING, left : columns.stop + RING]
        mask = labels[window] == number
        if np.count_nonzero(mask) < LEAST_PIXELS:
            continue
        row, column = np.nonzero(binary_dilation(mask, iterations=RING) & points[window])
        if len(row) < LEAST_POINTS:
            continue
        inside = np.nonzero(mask)
        low, middle, high = (np.quantile(inside, share, axis=1) for share in (0.05, 0.5, 0.95))
        ends = np.array([(low[0], low[1]), (low[0], high[1]), (high[0], low[1]), (high[0], high[1]), tuple(middle)])
        inverse = 1 / depth[window][row, column].astype(np.float64)
        rays, corners = rays_of(camera, row + top, column + left), rays_of(camera, ends[:, 0] + top, ends[:, 1] + left)
        grown = grown_alike(mask, grey[window], edge[window])
        at_edge = sure[window][row, column], grown[row, column]
        wide = grown & _near(mask & (from_edge[window] > WIDE), WIDE + RING)
        regions.append(PlainRegion(view, top, left, grown, rays, inverse, *at_edge, corners, wide))
    return regions


def _near(chosen: np.ndarray, reach: float) -> np.ndarray:
    """(H, W) bool: what is no farther than so many pixels from those that are `chosen` (H, W)."""
    return distance_transform_edt(~chosen) <= reach if chosen.any() else chosen


def regions_of_views(maps: Sequence[DepthMap], depths: Sequence[np.ndarray]) -> list[list[PlainRegion]]:
    """The plain regions of every view with its (H, W) `depths`, NaN where they are not sure.

    What is BEYOND all of these is never sure within 1 %, as it hardly moves, but it is behind every plane.
    """
    result = []
    for number, (found, depth) in enumerate(zip(maps, depths, strict=True)):
        sure = np.isfinite(depth)
        if sure.any():
            depth = np.where(~sure & (found.depth > BEYOND * np.median(depth[sure])), found.depth, depth)
        result.append(plain_regions(number, found.camera, found.grey, found.all_edges(), depth, sure))
    return result


def rays_of(camera: Camera, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """(..., 3) points of depth 1 in the camera's frame."""
    x, y = np.broadcast_arrays((column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def planes_of_region(region: PlainRegion, rng: np.random.Generator) -> list[tuple[int, np.ndarray]]:
    """Planes (3,) with ray . plane = inverse depth, and how many points are on them, by random triples of points."""
    found, left = [], region.sure.copy()
    for _ in range(PLANES_PER_REGION):
        rest = np.nonzero(left)[0]
        if len(rest) < LEAST_POINTS:
            break
        triples = rest[rng.integers(0, len(rest), (TRIPLES, 3))]
        corners = region.rays[triples]
        proper = np.abs(np.linalg.det(corners)) > 1e-4
        if not proper.any():
            break
        tried = np.linalg.solve(corners[proper], region.inverse[triples[proper]][..., None])[..., 0]
        off = region.off(tried)
        on, behind = region.are_on(off), off > BEHIND * TOLERANCE
        on = on[:, np.argmax((on & left[:, None]).sum(0) - 2 * behind.sum(0))]
        left &= ~on
        plane, on = _fitted(region, on)
        count = int(np.count_nonzero(on))
        if count >= max(LEAST_POINTS, ON_SHARE * len(on)) and _certain(region, plane, on):
            found.append((count, plane))
    return found


def _fitted(region: PlainRegion, on: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A plane by least squares of relative inverse depth, and the (N,) points on it."""
    plane = np.zeros(3)
    for _ in range(FITS):
        if np.count_nonzero(on) < LEAST_POINTS:
            break
        scaled = region.rays[on] / region.inverse[on, None]
        plane = np.linalg.lstsq(scaled, np.ones(len(scaled)), rcond=None)[0]
        on = region.are_on(region.off(plane[None]))[:, 0]
    return plane, on


def _certain(region: PlainRegion, plane: np.ndarray, on: np.ndarray) -> bool:
    """Whether nothing is behind a plane, and the points on it say where it is all over the region."""
    if np.count_nonzero(region.off(plane[None]) > BEHIND * TOLERANCE) > BEHIND_SHARE * len(on):
        return False
    scaled = region.rays[on] / region.inverse[on, None]
    # A point is within TOLERANCE: a standard deviation of half of it.
    information = scaled.T @ scaled / len(scaled) * min(len(scaled), INDEPENDENT_POINTS) / (TOLERANCE / 2) ** 2
    covariance = np.linalg.inv(information + 1e-9 * np.trace(information) * np.eye(3))
    inverse = region.corners @ plane
    deviation = np.sqrt(np.einsum("ki,ij,kj->k", region.corners, covariance, region.corners))
    return bool((inverse > 0).all() and (deviation < 2 * TOLERANCE * inverse).all())


@dataclass(frozen=True)
class FoundPlane:
    """A plane (4,) n . x = d of the world that a `region` has so many `points` on, and the `depth` and place in the
    world of the region's `middle` (3,) on it."""

    region: PlainRegion
    points: int
    plane: np.ndarray
    depth: float
    middle: np.ndarray

    @classmethod
    def on(cls, camera: Camera, region: PlainRegion, points: int, plane: np.ndarray) -> FoundPlane:
        """Of a plane of the world and the camera of the region."""
        ray = region.corners[4]
        depth = 1 / float(ray @ in_camera(camera, plane[None])[0])
        return cls(region, points, plane, depth, to_world(camera, ray[None] * depth)[0])


def found_planes(cameras: Sequence[Camera], regions: Sequence[PlainRegion], seed: int = 0) -> list[FoundPlane]:
    """Planes of single regions, those with the most points first."""
    rng, found = np.random.default_rng(seed), []
    for region in regions:
        camera = cameras[region.view]
        for count, plane in planes_of_region(region, rng):
            found.append(FoundPlane.on(camera, region, count, in_world(camera, plane)))
    return sorted(found, key=lambda one: -one.points)


def common_planes(
    cameras: Sequence[Camera], regions: Sequence[PlainRegion], found: Sequence[FoundPlane] | None = None
) -> np.ndarray:
    """(K, 4) planes (n, d) of the world, n . x = d, that are found in several views, fitted to the points of all
    regions on them. `found`: those of single regions, if they are known."""
    result = agreeing(cameras, found_planes(cameras, regions) if found is None else found)
    for _ in range(ROUNDS):
        result = _refitted(cameras, regions, *result)
    return result[0]


def agreeing(
    cameras: Sequence[Camera], found: Sequence[FoundPlane], spread: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The means (K, 4) of planes that are `found` in LEAST_VIEWS views and more, and how many radians apart two of
    these have to look (K,): `spread`, or by how the normals turn (`_least_spread`)."""
    weight, view = np.array([one.points for one in found]), np.array([one.region.view for one in found])
    depth, middle = np.array([one.depth for one in found]), np.array([one.middle for one in found])
    plane = np.array([one.plane for one in found])
    planes, spreads = list[np.ndarray](), list[float]()
    free = np.ones(len(found), bool)
    for first in range(len(found)):
        if not free[first]:
            continue
        mean = plane[first]
        same = _same(mean, plane[:, :3], middle, depth) & free
        same[first] = True
        normal = weight[same] @ plane[same, :3]
        normal /= np.linalg.norm(normal)
        mean = np.append(normal, np.average(middle[same] @ normal, weights=weight[same]))
        same = (_same(mean, plane[:, :3], middle, depth) | same) & free
        free &= ~same
        least = _least_spread(plane[same, :3], weight[same]) if spread is None else spread
        if seen_enough(cameras, view[same], np.average(middle[same], axis=0, weights=weight[same]), least):
            planes.append(mean)
            spreads.append(least)
    return np.array(planes).reshape(-1, 4), np.array(spreads)


def _least_spread(normals: np.ndarray, weight: np.ndarray) -> float:
    """How many radians apart two views have to look that have found (N, 3) normals of one plane, with (N,) weights: the
    plane of a round thing's silhouette turns as much as they do."""
    mean = weight @ normals
    angle = np.arccos(np.clip(normals @ (mean / np.linalg.norm(mean)), -1, 1))
    turning = STEADY * float(np.sqrt(np.average(angle**2, weights=weight)))
    return float(np.clip(turning, LEAST_SPREAD, SPREAD))


def _same(plane: np.ndarray, normals: np.ndarray, points: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """(N,) whether planes through points, seen at such depths, are this one."""
    near = np.abs(points @ plane[:3] - plane[3]) < TOLERANCE * depth
    return near & (normals @ plane[:3] > np.cos(SAME_ANGLE))


def seen_enough(cameras: Sequence[Camera], views: np.ndarray, point: np.ndarray, spread: float | None = None) -> bool:
    """Whether LEAST_VIEWS of `views`, numbers of cameras, differ, and two see a point from directions that do, by
    `spread` radians, SPREAD by default."""
    views = np.unique(views)
    if len(views) < LEAST_VIEWS:
        return False
    towards = np.array([cameras[view].center - point for view in views])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    return bool((towards @ towards.T).min() < np.cos(SPREAD if spread is None else spread))


def may_lie_on(region: PlainRegion, planes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of (K, 3) planes of the camera: which of a region's points are on them (N, K), and whether the region may lie on
    them (K,): enough of its points do, and hardly any is behind."""
    off, count = region.off(planes), len(region.inverse)
    on = region.are_on(off)
    behind = (off > BEHIND * TOLERANCE).sum(0)
    return on, (on.sum(0) >= max(LEAST_POINTS, ON_SHARE * count)) & (behind <= BEHIND_SHARE * count)


def _refitted(
    cameras: Sequence[Camera], regions: Sequence[PlainRegion], planes: np.ndarray, spreads: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Planes (K, 4) fitted to all points on them in regions that they explain, and the `spreads` (K,) of each; those
    that are uncertain or double go, and those that are not seen from directions so far apart."""
    points: list[list] = [[] for _ in planes]
    for region in regions if len(planes) else ():
        camera = cameras[region.view]
        on, fits = may_lie_on(region, in_camera(camera, planes))
        left = np.ones(len(on), bool)
        while True:  # the one with the most points first, then by those that are left
            counts = (on & left[:, None]).sum(0) * fits
            best = int(np.argmax(counts))
            if counts[best] < max(LEAST_POINTS, ON_SHARE * len(left)):
                break
            own = on[:, best]
            depth = 1 / region.inverse[own]
            place = to_world(camera, region.rays[own] * depth[:, None])
            points[best].append((place, depth, region.view, len(own)))
            left &= ~own
    fitted = []
    for plane, spread, parts in zip(planes, spreads, points, strict=True):
        if not parts:
            continue
        places, depths, views, counts = zip(*parts, strict=True)
        place, depth, views = np.concatenate(places), np.concatenate(depths), np.array(views)
        middle = np.average(place, axis=0, weights=depth**-2)
        around = place - middle
        variance, axes = np.linalg.eigh(around.T @ (around / depth[:, None] ** 2) / (depth**-2).sum())
        # The normal is as certain as the points are wide across the narrower side, and near to the plane.
        wide = np.sqrt(max(variance[1], 0)) * np.tan(SAME_ANGLE) * np.sqrt(len(np.unique(views)))
        scatter = 2 * float(np.sqrt(np.mean((around @ axes[:, 0] / depth) ** 2)))
        error = min(scatter, TOLERANCE) if len(place) > ALL_POINTS * sum(counts) else TOLERANCE
        if wide < error * np.median(depth) or not seen_enough(cameras, views, middle, spread):
            continue
        normal = axes[:, 0] * (1 if axes[:, 0] @ plane[:3] > 0 else -1)
        fitted.append((len(place), np.append(normal, normal @ middle), middle, float(np.median(depth)), spread))
    kept, least = list[np.ndarray](), list[float]()
    for _, plane, middle, depth, spread in sorted(fitted, key=lambda one: -one[0]):
        if not any(_same(other, plane[None, :3], middle[None], np.array([depth]))[0] for other in kept):
            kept.append(plane)
            least.append(spread)
    return np.array(kept).reshape(-1, 4), np.array(least)


def to_world(camera: Camera, points: np.ndarray) -> np.ndarray:
    """(..., 3) points of the camera's frame in the world's."""
    return (points - camera.world_to_camera[:3, 3]) @ camera.rotation


def in_world(camera: Camera, plane: np.ndarray) -> np.ndarray:
    """(n, d) of the world of a plane p . x = 1 of a camera."""
    length = np.linalg.norm(plane)
    return np.append(camera.rotation.T @ plane, 1 - plane @ camera.world_to_camera[:3, 3]) / length


def in_camera(camera: Camera, planes: np.ndarray) -> np.ndarray:
    """(K, 3) planes p . x = 1 of a camera of (K, 4) planes of the world; 0 for those through its centre."""
    normals = planes[:, :3] @ camera.rotation.T
    distance = planes[:, 3] + normals @ camera.world_to_camera[:3, 3]
    through = np.abs(distance) < 1e-9
    return np.where(through[:, None], 0, normals / np.where(through, 1, distance)[:, None])
