"""Planes of large flat surfaces, fitted to confirmed points of stereo.

On a floor or a wall with weak texture, stereo confirms only some depths, and these are noisy. Planes with many
confirmed points of several views, also by their normals, are found one after the other by RANSAC. The depth of such a
plane replaces confirmed depths that stereo cannot tell from it. It is also taken where most unconfirmed depths around
lie on it, as noise and outliers would not.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter

from linprim_geo.geometry.camera import Camera
from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.planes.plain_regions import FITS, LEAST_VIEWS, TOLERANCE, in_camera, rays_of, to_world

# Confirmed points of all views used in the search, those of them on which hypotheses are scored, and the number of
# hypotheses.
POINTS, TRIED_ON, SEEDS = 40_000, 4_000, 300
# The number of best hypotheses that are refitted, and the inlier thresholds, tried in turn. The residuals of a true
# plane are 0.0004 to 0.002 of the distance, or 0.003 where photographs are noisy (DECISIONS 101).
BEST_SEEDS, TOLERANCES = 10, (TOLERANCE / 4, TOLERANCE / 2, TOLERANCE)
# The most planes, and the least share of the points that are inliers of each.
MOST_PLANES, LEAST_SHARE = 30, 0.01
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
        normal = planes[:, :3].T
        off = np.abs(self.position @ normal - planes[:, 3])
        near = off < tolerance * np.abs((self.position - self.center) @ normal)
        return near & (np.abs(self.normal @ normal) > SAME_NORMAL)


def confirmed_points(
    maps: Sequence[DepthMap], depths: Sequence[np.ndarray]
) -> tuple[SurfacePoints, np.random.Generator]:
    """Sample about POINTS of the confirmed `depths` (H, W) of all views, NaN elsewhere. Return them and the random
    generator."""
    rng, count = np.random.default_rng(0), -(-POINTS // len(maps))
    views = enumerate(zip(maps, depths, strict=True))
    of_views = (SurfacePoints.of_view(k, found.camera, depth, found.normal, count, rng) for k, (found, depth) in views)
    return SurfacePoints.together(of_views), rng


def planes_of_points(maps: Sequence[DepthMap], depths: Sequence[np.ndarray]) -> np.ndarray:
    """Return the (K, 4) planes n . x = d of the world with the most inliers among the confirmed `depths` (H, W) of
    views, NaN elsewhere.

    Planes that hold their points within the least of TOLERANCES come first: with a large threshold, a plane may lie
    across two surfaces, such as a picture on a wall and the head of a bed in front of it, and on neither.
    """
    points, rng = confirmed_points(maps, depths)
    least, planes, free = max(LEAST_SHARE * len(points), 3), list[np.ndarray](), np.arange(len(points))
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


def _fitted(points: SurfacePoints) -> np.ndarray:
    """Fit a plane (4,) to points by least squares, weighted by 1 / distance, as far points are less exact."""
    weight = 1 / np.maximum(np.linalg.norm(points.position - points.center, axis=1), 1e-12)
    middle = np.average(points.position, axis=0, weights=weight**2)
    scaled = (points.position - middle) * weight[:, None]
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
