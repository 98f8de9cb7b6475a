"""Planes of regions without texture, such as painted walls.

Stereo finds depths along the edges of a plain region, but none inside it. Plane hypotheses are therefore fitted to the
confirmed depths along these edges. Some of these points belong to occluders and lie in front of the plane; hardly any
may lie behind it. A plane is kept if several views from different directions find the same one. This rejects the
silhouettes of round objects, which give a different plane in each view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt, find_objects, label, uniform_filter

from linprim_geo.geometry.camera import Camera
from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.evidence import CONFIRMED_DEPTH

# The least area of a region in pixels (two windows of stereo), the fewest confirmed depths along its edges, and how far
# around the region, in pixels, these depths are collected.
LEAST_PIXELS, LEAST_POINTS, RING = 200, 30, 4
# Stereo gives the depth of an edge to pixels up to ten beside it (DECISIONS 126). A pixel without an edge within twice
# that distance, in pixels, is therefore certainly plain.
WIDE = 20
# Half of the grey difference that ends the arm of a cross (`csrc/stereo/cross.h`), and the side in pixels of the square
# over which the mean grey of a region is taken.
HALF_EDGE, AROUND = 12.5, 9
# Depths beyond this many times the median of the view's sure depths are taken for a far background. Six in ten depths
# at edges of a background are, and one in 3,000 of those of surfaces (DECISIONS 90).
BEYOND = 10.0
# A depth is an inlier of a plane if it differs from it by at most the share TOLERANCE of the depth; it is behind the
# plane from BEHIND times as much.
TOLERANCE, BEHIND = CONFIRMED_DEPTH, 3.0
# The least share of a region's confirmed depths that are inliers of its plane, and the largest share that may be behind
# it.
ON_SHARE, BEHIND_SHARE = 0.1, 0.1
# Per region: random triples of points tried for each plane, planes looked for at most, and least-squares fits of each
# plane to its inliers.
TRIPLES, PLANES_PER_REGION, FITS = 300, 4, 3
# Errors of points along one edge are correlated: all inliers together count as at most this many independent points.
INDEPENDENT_POINTS = 20
# A plane is accepted if at least so many views find it and two of them see it from directions that differ by at least
# VIEW_ANGLE radians.
LEAST_VIEWS, VIEW_ANGLE = 3, np.radians(10)
# A smaller difference of directions, down to LEAST_VIEW_ANGLE radians, is enough if the normals found by the views
# agree: their angular deviation has to be at most half of that of silhouettes, whose normals turn with the view and so
# have a standard deviation of t / sqrt 12 over views that span an angle t.
STEADY, LEAST_VIEW_ANGLE = 2 * np.sqrt(12), np.radians(6)
# Two planes are the same if the angle of their normals is below this, in radians, and their offset is below TOLERANCE
# times the depth.
SAME_ANGLE = np.radians(3)
# The error of a plane is estimated from the scatter of its inliers only if these are more than this share of all points
# of its regions. If they are fewer, they were selected for being near the plane, and their scatter only shows the
# threshold.
ALL_POINTS = 0.9
# Rounds in which regions are assigned to planes and the planes are refitted to all inliers.
ROUNDS = 3


@dataclass(frozen=True)
class PlainRegion:
    """A connected region without texture in view number `view`.

    `mask` (h, w) bool covers a window whose first pixel is (`top`, `left`), extended by `grown_alike`. Of it, `wide` is
    the part that circles of radius WIDE without an edge cover, with the edges beside these. Of the N points along the
    edges: `rays` (N, 3) of depth 1, `inverse` depths (N,), `sure` (N,) bool, false for far depths that can be on no
    plane, and `inner` (N,) bool, true within the mask. `corners` (5, 3) are rays to its four ends and its middle.
    """

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
        """Return (P,) rows and (P,) columns of the mask's pixels in the image."""
        row, column = np.nonzero(self.mask)
        return row + self.top, column + self.left

    def within(self) -> PlainRegion:
        """Return the region with only its inner points."""
        return replace(
            self,
            rays=self.rays[self.inner],
            inverse=self.inverse[self.inner],
            sure=self.sure[self.inner],
            inner=self.inner[self.inner],
        )

    def residuals(self, planes: np.ndarray) -> np.ndarray:
        """Return the (N, K) relative residuals of the points to (K, 3) planes: inverse depth of the plane over that of
        the point, less 1; positive where the point is behind the plane."""
        return (self.rays @ planes.T) / self.inverse[:, None] - 1

    def are_inliers(self, off: np.ndarray) -> np.ndarray:
        """Return (N, K) bool: which points are inliers of the planes, by their residuals `off` (N, K)."""
        return (np.abs(off) < TOLERANCE) & self.sure[:, None]


def grown_alike(region: np.ndarray, grey: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """Return the (H, W) mask of a plain region, without `edge` pixels, extended into edges: by edge pixels within RING
    pixels of it whose grey differs from its mean there by less than HALF_EDGE. Blur mixes the colours of both sides on
    an edge."""
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
    """Return the regions of an image `grey` (H, W) between its edges. `depth` (H, W) is NaN where unknown; `sure` (H,
    W) is false where it is only known to be far."""
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
    """Return (H, W) bool: the pixels within `reach` pixels of `chosen` ones (H, W)."""
    return distance_transform_edt(~chosen) <= reach if chosen.any() else chosen


def regions_of_views(maps: Sequence[DepthMap], depths: Sequence[np.ndarray]) -> list[list[PlainRegion]]:
    """Return the plain regions of every view, given its sure `depths` (H, W), NaN elsewhere.

    Depths BEYOND the median are kept as well, as not sure: they are never known within 1 %, for lack of parallax, but
    they are certainly behind every plane.
    """
    result = []
    for number, (found, depth) in enumerate(zip(maps, depths, strict=True)):
        sure = np.isfinite(depth)
        if sure.any():
            depth = np.where(~sure & (found.depth > BEYOND * np.median(depth[sure])), found.depth, depth)
        result.append(plain_regions(number, found.camera, found.grey, found.all_edges(), depth, sure))
    return result


def rays_of(camera: Camera, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Return (..., 3) rays of depth 1 through pixels, in the camera's frame."""
    x, y = np.broadcast_arrays((column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def planes_of_region(region: PlainRegion, rng: np.random.Generator) -> list[tuple[int, np.ndarray]]:
    """Find planes of one region by RANSAC over random triples of points. Return pairs of an inlier count and a plane
    (3,), for which ray . plane = inverse depth."""
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
        off = region.residuals(tried)
        on, behind = region.are_inliers(off), off > BEHIND * TOLERANCE
        on = on[:, np.argmax((on & left[:, None]).sum(0) - 2 * behind.sum(0))]
        left &= ~on
        plane, on = _fitted(region, on)
        count = int(np.count_nonzero(on))
        if count >= max(LEAST_POINTS, ON_SHARE * len(on)) and _certain(region, plane, on):
            found.append((count, plane))
    return found


def _fitted(region: PlainRegion, on: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit a plane by least squares of relative inverse depths. Return the plane (3,) and its inliers (N,)."""
    plane = np.zeros(3)
    for _ in range(FITS):
        if np.count_nonzero(on) < LEAST_POINTS:
            break
        scaled = region.rays[on] / region.inverse[on, None]
        plane = np.linalg.lstsq(scaled, np.ones(len(scaled)), rcond=None)[0]
        on = region.are_inliers(region.residuals(plane[None]))[:, 0]
    return plane, on


def _certain(region: PlainRegion, plane: np.ndarray, on: np.ndarray) -> bool:
    """Return whether hardly any point is behind a plane, and its inliers fix its depth all over the region."""
    if np.count_nonzero(region.residuals(plane[None]) > BEHIND * TOLERANCE) > BEHIND_SHARE * len(on):
        return False
    scaled = region.rays[on] / region.inverse[on, None]
    # An inlier is within TOLERANCE: half of that is taken as its standard deviation.
    information = scaled.T @ scaled / len(scaled) * min(len(scaled), INDEPENDENT_POINTS) / (TOLERANCE / 2) ** 2
    covariance = np.linalg.inv(information + 1e-9 * np.trace(information) * np.eye(3))
    inverse = region.corners @ plane
    deviation = np.sqrt(np.einsum("ki,ij,kj->k", region.corners, covariance, region.corners))
    return bool((inverse > 0).all() and (deviation < 2 * TOLERANCE * inverse).all())


@dataclass(frozen=True)
class FoundPlane:
    """A plane (4,) n . x = d of the world found in one `region`, with the count of its inliers, `points`. `depth` and
    `middle` (3,) are the depth and the position in the world of the region's middle on the plane."""

    region: PlainRegion
    points: int
    plane: np.ndarray
    depth: float
    middle: np.ndarray

    @classmethod
    def on(cls, camera: Camera, region: PlainRegion, points: int, plane: np.ndarray) -> FoundPlane:
        """Make one from a plane (4,) of the world and the camera of the region."""
        ray = region.corners[4]
        depth = 1 / float(ray @ in_camera(camera, plane[None])[0])
        return cls(region, points, plane, depth, to_world(camera, ray[None] * depth)[0])


def found_planes(cameras: Sequence[Camera], regions: Sequence[PlainRegion], seed: int = 0) -> list[FoundPlane]:
    """Return the planes of all regions, each found by itself, sorted by descending inlier count."""
    rng, found = np.random.default_rng(seed), []
    for region in regions:
        camera = cameras[region.view]
        for count, plane in planes_of_region(region, rng):
            found.append(FoundPlane.on(camera, region, count, in_world(camera, plane)))
    return sorted(found, key=lambda one: -one.points)


def common_planes(
    cameras: Sequence[Camera], regions: Sequence[PlainRegion], found: Sequence[FoundPlane] | None = None
) -> np.ndarray:
    """Return (K, 4) planes (n, d) of the world, n . x = d, that several views find, refitted to the inliers in all
    regions. `found` are the planes of single regions, if they are already known."""
    result = agreeing(cameras, found_planes(cameras, regions) if found is None else found)
    for _ in range(ROUNDS):
        result = _refitted(cameras, regions, *result)
    return result[0]


def agreeing(
    cameras: Sequence[Camera], found: Sequence[FoundPlane], view_angle: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Cluster the planes of single regions. Return (K, 4) means of those found in at least LEAST_VIEWS views, and (K,)
    by how many radians the directions of two of these views have to differ: `view_angle`, or by the scatter of normals
    (`_least_view_angle`)."""
    weight, view = np.array([one.points for one in found]), np.array([one.region.view for one in found])
    depth, middle = np.array([one.depth for one in found]), np.array([one.middle for one in found])
    plane = np.array([one.plane for one in found])
    planes, view_angles = list[np.ndarray](), list[float]()
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
        least = _least_view_angle(plane[same, :3], weight[same]) if view_angle is None else view_angle
        if has_wide_baseline(cameras, view[same], np.average(middle[same], axis=0, weights=weight[same]), least):
            planes.append(mean)
            view_angles.append(least)
    return np.array(planes).reshape(-1, 4), np.array(view_angles)


def _least_view_angle(normals: np.ndarray, weight: np.ndarray) -> float:
    """Return by how many radians the viewing directions of a plane have to differ, given the (N, 3) normals that views
    have found and (N,) weights: normals of the silhouette of a round object turn as much as the view does."""
    mean = weight @ normals
    angle = np.arccos(np.clip(normals @ (mean / np.linalg.norm(mean)), -1, 1))
    turning = STEADY * float(np.sqrt(np.average(angle**2, weights=weight)))
    return float(np.clip(turning, LEAST_VIEW_ANGLE, VIEW_ANGLE))


def _same(plane: np.ndarray, normals: np.ndarray, points: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return (N,) bool: which of N planes, given by normals, points on them and the depths of these, are the same as
    `plane`."""
    near = np.abs(points @ plane[:3] - plane[3]) < TOLERANCE * depth
    return near & (normals @ plane[:3] > np.cos(SAME_ANGLE))


def has_wide_baseline(
    cameras: Sequence[Camera], views: np.ndarray, point: np.ndarray, view_angle: float | None = None
) -> bool:
    """Return whether `views`, numbers of cameras, are at least LEAST_VIEWS different ones, and the directions from
    which two of them see `point` differ by at least `view_angle` radians (default VIEW_ANGLE)."""
    views = np.unique(views)
    if len(views) < LEAST_VIEWS:
        return False
    towards = np.array([cameras[view].center - point for view in views])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    return bool((towards @ towards.T).min() < np.cos(VIEW_ANGLE if view_angle is None else view_angle))


def may_lie_on(region: PlainRegion, planes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Test (K, 3) planes of the camera. Return (N, K) bool, which points of the region are inliers, and (K,) bool,
    whether the region may lie on the plane: it has enough inliers, and hardly any point is behind."""
    off, count = region.residuals(planes), len(region.inverse)
    on = region.are_inliers(off)
    behind = (off > BEHIND * TOLERANCE).sum(0)
    return on, (on.sum(0) >= max(LEAST_POINTS, ON_SHARE * count)) & (behind <= BEHIND_SHARE * count)


def _refitted(
    cameras: Sequence[Camera], regions: Sequence[PlainRegion], planes: np.ndarray, view_angles: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Refit planes (K, 4) to their inliers in all regions assigned to them. Return those kept and their `view_angles`.
    Planes are dropped if they are uncertain, duplicates, or not seen from directions that differ by their
    view_angle."""
    points: list[list] = [[] for _ in planes]
    for region in regions if len(planes) else ():
        camera = cameras[region.view]
        on, fits = may_lie_on(region, in_camera(camera, planes))
        left = np.ones(len(on), bool)
        while True:  # the plane with the most inliers first, then by the points that are left
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
    for plane, view_angle, parts in zip(planes, view_angles, points, strict=True):
        if not parts:
            continue
        places, depths, views, counts = zip(*parts, strict=True)
        place, depth, views = np.concatenate(places), np.concatenate(depths), np.array(views)
        middle = np.average(place, axis=0, weights=depth**-2)
        around = place - middle
        variance, axes = np.linalg.eigh(around.T @ (around / depth[:, None] ** 2) / (depth**-2).sum())
        # The normal is as certain as the inliers are spread along the narrower side, relative to their distance from
        # the plane.
        wide = np.sqrt(max(variance[1], 0)) * np.tan(SAME_ANGLE) * np.sqrt(len(np.unique(views)))
        scatter = 2 * float(np.sqrt(np.mean((around @ axes[:, 0] / depth) ** 2)))
        error = min(scatter, TOLERANCE) if len(place) > ALL_POINTS * sum(counts) else TOLERANCE
        if wide < error * np.median(depth) or not has_wide_baseline(cameras, views, middle, view_angle):
            continue
        normal = axes[:, 0] * (1 if axes[:, 0] @ plane[:3] > 0 else -1)
        fitted.append((len(place), np.append(normal, normal @ middle), middle, float(np.median(depth)), view_angle))
    kept, least = list[np.ndarray](), list[float]()
    for _, plane, middle, depth, view_angle in sorted(fitted, key=lambda one: -one[0]):
        if not any(_same(other, plane[None, :3], middle[None], np.array([depth]))[0] for other in kept):
            kept.append(plane)
            least.append(view_angle)
    return np.array(kept).reshape(-1, 4), np.array(least)


def to_world(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Transform (..., 3) points from the camera's frame to the world's."""
    return (points - camera.world_to_camera[:3, 3]) @ camera.rotation


def in_world(camera: Camera, plane: np.ndarray) -> np.ndarray:
    """Transform a plane p . x = 1 of the camera's frame to (n, d) of the world, with unit normal n."""
    length = np.linalg.norm(plane)
    return np.append(camera.rotation.T @ plane, 1 - plane @ camera.world_to_camera[:3, 3]) / length


def in_camera(camera: Camera, planes: np.ndarray) -> np.ndarray:
    """Transform (K, 4) planes of the world to (K, 3) planes p . x = 1 of the camera's frame; 0 for planes through its
    centre."""
    normals = planes[:, :3] @ camera.rotation.T
    distance = planes[:, 3] + normals @ camera.world_to_camera[:3, 3]
    through = np.abs(distance) < 1e-9
    return np.where(through[:, None], 0, normals / np.where(through, 1, distance)[:, None])
