"""Planes of large flat surfaces, fitted to confirmed points of stereo.

On a floor or a wall with weak texture, stereo confirms only some depths, and these are noisy. Planes with many
confirmed points of several views, also by their normals, are found one after the other by RANSAC, and then refitted
together, each to the points that lie on it better than on any other. The depth of such a plane replaces confirmed
depths that stereo cannot tell from it. It is also taken where most unconfirmed depths around lie on it, as noise and
outliers would not.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter

from linprim_geo.geometry.camera import Camera
from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.planes.plain_regions import BEHIND, FITS, LEAST_VIEWS, TOLERANCE, in_camera, rays_of, to_world

# Confirmed points of all views used in the search, those of them on which hypotheses are scored, and the number of
# hypotheses.
POINTS, TRIED_ON, SEEDS = 40_000, 4_000, 300
# The number of best hypotheses that are refitted, and the inlier thresholds, tried in turn. The residuals of a true
# plane are 0.0004 to 0.002 of the distance, or 0.003 where photographs are noisy (DECISIONS 101).
BEST_SEEDS, TOLERANCES = 10, (TOLERANCE / 4, TOLERANCE / 2, TOLERANCE)
# The most planes, and the least share of the points that are inliers of each.
MOST_PLANES, LEAST_SHARE = 30, 0.01
# Rounds in which all planes are refitted together, and the least share of a plane's points that no other one holds.
ROUNDS, OWN_SHARE = 10, 0.5
# Normals of inliers are within 30 degrees of the plane's normal (a cosine).
SAME_NORMAL = float(np.cos(np.radians(30)))
# At least this share of the points within TOLERANCE of a plane is within half of it. Across a curved surface it is one
# half.
CENTRAL_SHARE = 0.7
# A pixel without a confirmed depth takes that of a plane if more than this share of the WINDOW by WINDOW pixels around
# have depths on it.
WINDOW, ON_SHARE = 15, 0.5
# A confirmed depth is replaced if at least the share NEARLY_ALL of confirmed depths around are inliers, and their mean
# residual is at most MOST_MEAN_RESIDUAL times their mean deviation: noise leaves as much in the mean of a few windows
# of stereo.
NEARLY_ALL, MOST_MEAN_RESIDUAL = 0.8, 0.5


@dataclass(frozen=True)
class SurfacePoints:
    """Points of surfaces: `position` (P, 3) in the world, `normal` (P, 3), `center` (P, 3) of the camera that sees
    each, and number `view` (P,) of that camera."""

    position: np.ndarray
    normal: np.ndarray
    center: np.ndarray
    view: np.ndarray

    @classmethod
    def of_view(
        cls,
        view: int,
        camera: Camera,
        depth: np.ndarray,
        normal: np.ndarray,
        count: int,
        rng: np.random.Generator,
    ) -> SurfacePoints:
        """Sample at most `count` points from the (H, W) depths of a view, NaN where unknown, with their (H, W, 3)
        normals."""
        row, column = np.nonzero(np.isfinite(depth))
        some = rng.permutation(len(row))[:count]
        row, column = row[some], column[some]
        points = to_world(camera, rays_of(camera, row, column) * depth[row, column, None])
        center = np.broadcast_to(camera.center, points.shape)
        return cls(points, normal[row, column].astype(np.float64), center, np.full(len(row), view))

    @classmethod
    def together(cls, parts: Iterable[SurfacePoints]) -> SurfacePoints:
        """Concatenate several sets of points."""
        columns = zip(*((one.position, one.normal, one.center, one.view) for one in parts), strict=True)
        return cls(*map(np.concatenate, columns))

    def __len__(self) -> int:
        return len(self.view)

    def __getitem__(self, rows: np.ndarray) -> SurfacePoints:
        return SurfacePoints(self.position[rows], self.normal[rows], self.center[rows], self.view[rows])

    def on(self, planes: np.ndarray, tolerance: float = TOLERANCE) -> np.ndarray:
        """Return (P, K) bool: which points are inliers of (K, 4) planes, up to a share of their distance, with similar
        normals."""
        return self.residuals(planes) < tolerance

    def residuals(self, planes: np.ndarray) -> np.ndarray:
        """Return (P, K) how far (K, 4) planes are from the points along the rays of their cameras, as a share of the
        distance; infinite where normals are not similar."""
        normal = planes[:, :3].T
        off = np.abs(self.position @ normal - planes[:, 3])
        with np.errstate(divide="ignore", invalid="ignore"):  # rays parallel to the plane
            share = off / np.abs((self.position - self.center) @ normal)
        return np.where(np.abs(self.normal @ normal) > SAME_NORMAL, np.nan_to_num(share, nan=np.inf), np.inf)


def confirmed_points(
    maps: Sequence[DepthMap], depths: Sequence[np.ndarray]
) -> tuple[SurfacePoints, np.random.Generator]:
    """Sample about POINTS of the confirmed `depths` (H, W) of all views, NaN elsewhere. Return them and the random
    generator."""
    rng, count = np.random.default_rng(0), -(-POINTS // len(maps))
    views = enumerate(zip(maps, depths, strict=True))
    of_views = (SurfacePoints.of_view(k, found.camera, depth, found.normal, count, rng) for k, (found, depth) in views)
    return SurfacePoints.together(of_views), rng


def planes_of_points(points: SurfacePoints, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the (K, 4) planes n . x = d of the world with the most inliers among points, and the (K,) sums of the
    `closeness` of each plane's points to it.

    Planes that hold their points within the least of TOLERANCES are found first: with a large threshold, a plane may
    lie across two surfaces, such as a picture on a wall and the head of a bed in front of it, and on neither. All are
    then refitted together, to the points that are closest to each, and planes without enough points of their own are
    removed: one that lies across two surfaces loses its points to those of the surfaces.
    """
    least = max(LEAST_SHARE * len(points), 3)
    planes = _found_in_turn(points, least, rng)
    for _ in range(ROUNDS):
        planes = _kept_together(points, _refitted(points, planes), least / 2)
    residuals = points.residuals(planes)
    near = closeness(residuals)
    own = near.argmax(1) if len(planes) else np.zeros(len(points), int)
    kept = []
    for k in range(len(planes)):
        mine = own == k
        central, on = (mine & (residuals[:, k] < part) for part in (TOLERANCE / 2, TOLERANCE))
        flat = np.count_nonzero(central) >= CENTRAL_SHARE * np.count_nonzero(on)
        if flat and len(np.unique(points.view[on])) >= LEAST_VIEWS:
            kept.append(k)
    return planes[kept], np.array([near[own == k, k].sum() for k in kept])


def closeness(residuals: np.ndarray) -> np.ndarray:
    """Return how well points lie on planes, from 1 down to 0 at TOLERANCE, given their residuals: the mean of Tukey's
    biweight functions of the TOLERANCES. Their sum is largest for planes that hold their points most closely."""
    return np.mean([np.maximum(0, 1 - (residuals / part) ** 2) ** 2 for part in TOLERANCES], axis=0)


def with_normal(points: SurfacePoints, plane: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return a plane (4,) with another `normal` (3,), at the place where the points near it before are closest."""
    near = points[points.residuals(plane[None])[:, 0] < BEHIND * TOLERANCE]
    along = near.position @ normal
    towards = np.abs(along - near.center @ normal)
    turned = np.append(normal, np.median(along))
    for _ in range(ROUNDS):
        weight = _weights(near.residuals(turned[None])[:, 0]) / np.maximum(towards, 1e-12) ** 2
        if not weight.any():
            break
        turned[3] = np.average(along, weights=weight)
    return turned


def _found_in_turn(points: SurfacePoints, least: float, rng: np.random.Generator) -> np.ndarray:
    """Return (K, 4) planes with `least` points or more, found one after the other among the points left."""
    planes, free = list[np.ndarray](), np.arange(len(points))
    for tolerance in TOLERANCES:
        left = free
        while len(planes) < MOST_PLANES and len(left) >= least:
            rest = points[left]
            plane = _commonest_plane(rest, tolerance, least, rng)
            if plane is None:
                break
            on = rest.on(plane[None], tolerance)[:, 0]
            central = np.count_nonzero(rest.on(plane[None], tolerance / 2))
            if central >= CENTRAL_SHARE * np.count_nonzero(on) and len(np.unique(rest.view[on])) >= LEAST_VIEWS:
                planes.append(plane)
                free = free[~points[free].on(plane[None])[:, 0]]
            left = left[~rest.on(plane[None])[:, 0]]
    return np.array(planes).reshape(-1, 4)


def _refitted(points: SurfacePoints, planes: np.ndarray) -> np.ndarray:
    """Return each plane refitted to the points that are closer to it than to the others."""
    if not len(planes):
        return planes
    residuals, refitted = points.residuals(planes), planes.copy()
    own = residuals.argmin(1)
    for k in range(len(planes)):
        weight = _weights(residuals[:, k]) * (own == k)
        if np.count_nonzero(weight) >= 3:
            refitted[k] = _fitted(points[weight > 0], weight[weight > 0])
    return refitted


def _weights(residuals: np.ndarray) -> np.ndarray:
    """Return the weights of points in least squares that maximise the sum of their `closeness`."""
    return np.sum([np.maximum(0, 1 - (residuals / part) ** 2) / part**2 for part in TOLERANCES], axis=0)


def _kept_together(points: SurfacePoints, planes: np.ndarray, least: float) -> np.ndarray:
    """Return the planes that each add `least` or more, and OWN_SHARE of what they have by themselves, to the sum of the
    points' `closeness` to the nearest plane, the one that adds most first."""
    near, best = closeness(points.residuals(planes)), np.zeros(len(points))
    kept = list[int]()
    while len(planes):
        added = np.maximum(0, near - best[:, None]).sum(0)
        added[added < OWN_SHARE * near.sum(0)] = 0
        most = int(added.argmax())
        if added[most] < least:
            break
        kept.append(most)
        best = np.maximum(best, near[:, most])
    return planes[kept]


def _commonest_plane(
    points: SurfacePoints, tolerance: float, least: float, rng: np.random.Generator
) -> np.ndarray | None:
    """Return the plane (4,) with the highest score: points within half of a `tolerance`, less those in its outer half.
    A surface that crosses the plane scores zero. None if fewer than `least` points are inliers."""
    seeds = points[rng.integers(0, len(points), SEEDS)]
    tried = np.column_stack([seeds.normal, (seeds.normal * seeds.position).sum(1)])
    some = points[rng.permutation(len(points))[:TRIED_ON]]
    # Normals of single points are not exact enough for a small threshold.
    best, most = None, -len(some)
    for seed in tried[np.argsort(-some.on(tried, tolerance).sum(0), kind="stable")[:BEST_SEEDS]]:
        plane = _fitted_within(some, seed, tolerance, 3)
        if plane is not None:
            central, on = (np.count_nonzero(some.on(plane[None], part)) for part in (tolerance / 2, tolerance))
            if 2 * central - on > most:
                best, most = plane, 2 * central - on
    return None if best is None else _fitted_within(points, best, tolerance, least)


def _fitted_within(points: SurfacePoints, plane: np.ndarray, tolerance: float, least: float) -> np.ndarray | None:
    """Fit a plane to its inliers, within TOLERANCE at first and then within a smaller `tolerance`. None if these are
    fewer than `least`."""
    for step in range(FITS):
        on = points.on(plane[None], max(TOLERANCE / 2**step, tolerance))[:, 0]
        if np.count_nonzero(on) < least:
            return None
        plane = _fitted(points[on])
    return plane if np.count_nonzero(points.on(plane[None], tolerance)) >= least else None


def _fitted(points: SurfacePoints, weight: np.ndarray | None = None) -> np.ndarray:
    """Fit a plane (4,) to points by least squares, weighted by 1 / distance, as far points are less exact, and by the
    square root of (P,) `weight`."""
    exact = 1 / np.maximum(np.linalg.norm(points.position - points.center, axis=1), 1e-12)
    exact = exact if weight is None else exact * np.sqrt(weight)
    middle = np.average(points.position, axis=0, weights=exact**2)
    scaled = (points.position - middle) * exact[:, None]
    normal = np.linalg.eigh(scaled.T @ scaled)[1][:, 0]
    return np.append(normal, normal @ middle)


def point_plane_depth(found: DepthMap, confirmed: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Return the (H, W) float32 depth of the plane on which most depths around lie, NaN elsewhere.

    A confirmed depth is replaced only if stereo cannot tell the plane from it: nearly all confirmed depths around are
    inliers, and their mean residual is less than their deviation from those of other views. Relief thus remains.

    Args:
        confirmed: (H, W) confirmed depth of the view, NaN elsewhere.
        planes: (K, 4) of the world.
    """
    height, width = found.grey.shape
    rays = found.camera.ray_grid()
    known = np.isfinite(found.depth)
    own = np.where(known, found.depth, 1)
    inverse, most, off = np.zeros((height, width)), np.zeros((height, width)), np.ones((height, width))
    for plane, local in zip(planes, in_camera(found.camera, planes), strict=True):
        by_plane = rays @ local
        plane_residuals = np.where(known & (by_plane > 0), by_plane * own - 1, 1)
        on = (np.abs(plane_residuals) < TOLERANCE) & (np.abs(found.normal @ plane[:3]) > SAME_NORMAL)
        if on.any():
            share = _mean_around(on)
            better = share > most
            most[better], inverse[better], off[better] = share[better], by_plane[better], plane_residuals[better]
    sure, on = np.isfinite(confirmed), np.abs(off) < TOLERANCE
    on_sure = on & sure
    nearly_all = _mean_around(on_sure) >= NEARLY_ALL * _mean_around(sure)
    error, deviation = (_mean_around(np.where(on_sure, image, 0)) for image in (off, found.deviation))
    alike = np.abs(error) <= MOST_MEAN_RESIDUAL * deviation
    taken = np.where(sure, on & nearly_all & alike, most > ON_SHARE)
    with np.errstate(divide="ignore"):
        return np.where(taken, 1 / inverse, np.nan).astype(np.float32)


def _mean_around(image: np.ndarray) -> np.ndarray:
    """Return the (H, W) mean over WINDOW by WINDOW pixels."""
    return uniform_filter(image.astype(np.float64), WINDOW, mode="constant")
