"""Planes of large flat surfaces, by the points that stereo confirms on them.

A floor or a wall with weak texture is confirmed here and there, and bumpy. Planes that many confirmed points of several
views lie on, with their normals, are found one after the other. The depth of such a plane is taken where stereo cannot
tell it from confirmed depths, and where depths that nothing confirms lie on it as noise and mistakes would not.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter

from linprim_geo.geometry.camera import Camera
from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.planes.plain_regions import FITS, LEAST_VIEWS, TOLERANCE, in_camera, rays_of, to_world

# Confirmed points of all views that planes are looked for in, of these that seeds are tried on, and seeds.
POINTS, TRIED_ON, SEEDS = 40_000, 4_000, 300
# Of the seeds so many are fitted. Points are on a plane within each of TOLERANCES in turn: points deviate from a true
# plane by a share of 0.0004 to 0.002 of their distance, or 0.003 where photographs are noisy (DECISIONS 101).
BEST_SEEDS, TOLERANCES = 10, (TOLERANCE / 4, TOLERANCE / 2, TOLERANCE)
# Planes at most, and the least share of the points that one has.
MOST_PLANES, LEAST_SHARE = 30, 0.01
# Normals of points on a plane are within 30 degrees of its own.
SAME_NORMAL = float(np.cos(np.radians(30)))
# Of points within TOLERANCE of a plane so many are within half of it. Across a curved surface it is one half.
CENTRAL_SHARE = 0.7
# Depths are taken from a plane where this share of the WINDOW by WINDOW pixels around has depths on it.
WINDOW, ON_SHARE = 15, 0.5
# The least share of confirmed depths around that are on a plane where stereo cannot tell it from them, and how much of
# their deviation they are off in the mean: what noise leaves in the mean of a few windows of stereo.
NEARLY_ALL, UNTOLD = 0.8, 0.5


@dataclass(frozen=True)
class SurfacePoints:
    """Points (P, 3) of the world, their normals, the centres of the cameras that see them, and the views (P,)."""

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
        """At most `count` at the (H, W) depths of a view, NaN where unknown, with their (H, W, 3) normals."""
        row, column = np.nonzero(np.isfinite(depth))
        some = rng.permutation(len(row))[:count]
        row, column = row[some], column[some]
        points = to_world(camera, rays_of(camera, row, column) * depth[row, column, None])
        center = np.broadcast_to(camera.center, points.shape)
        return cls(points, normal[row, column].astype(np.float64), center, np.full(len(row), view))

    @classmethod
    def together(cls, parts: Iterable[SurfacePoints]) -> SurfacePoints:
        columns = zip(*((one.position, one.normal, one.center, one.view) for one in parts), strict=True)
        return cls(*map(np.concatenate, columns))

    def __len__(self) -> int:
        return len(self.view)

    def __getitem__(self, rows: np.ndarray) -> SurfacePoints:
        return SurfacePoints(self.position[rows], self.normal[rows], self.center[rows], self.view[rows])

    def on(self, planes: np.ndarray, tolerance: float = TOLERANCE) -> np.ndarray:
        """(P, K) bool which are on (K, 4) planes up to a share of their distance, with normals alike."""
        normal = planes[:, :3].T
        off = np.abs(self.position @ normal - planes[:, 3])
        near = off < tolerance * np.abs((self.position - self.center) @ normal)
        return near & (np.abs(self.normal @ normal) > SAME_NORMAL)


def confirmed_points(
    maps: Sequence[DepthMap], depths: Sequence[np.ndarray]
) -> tuple[SurfacePoints, np.random.Generator]:
    """About POINTS of the confirmed `depths` (H, W) of views, NaN elsewhere, and the generator that chose them."""
    rng, count = np.random.default_rng(0), -(-POINTS // len(maps))
    views = enumerate(zip(maps, depths, strict=True))
    of_views = (SurfacePoints.of_view(k, found.camera, depth, found.normal, count, rng) for k, (found, depth) in views)
    return SurfacePoints.together(of_views), rng


def planes_of_points(maps: Sequence[DepthMap], depths: Sequence[np.ndarray]) -> np.ndarray:
    """(K, 4) planes n . x = d of the world with the most of the confirmed `depths` (H, W) of views, NaN elsewhere.

    Those come first that hold their points within the least of TOLERANCES: within a large one a plane may lie across
    two surfaces, such as a picture on a wall and the head of a bed before it, and on neither.
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
    """The plane (4,) that holds the most of points within half of a `tolerance`, less those in its other half; None
    if fewer than `least` are within it. Points that lie across it come out even."""
    seeds = points[rng.integers(0, len(points), SEEDS)]
    tried = np.column_stack([seeds.normal, (seeds.normal * seeds.position).sum(1)])
    some = points[rng.permutation(len(points))[:TRIED_ON]]
    # Normals of points alone are not exact enough for a small tolerance.
    best, most = None, -len(some)
    for seed in tried[np.argsort(-some.on(tried, tolerance).sum(0), kind="stable")[:BEST_SEEDS]]:
        plane = _fitted_within(some, seed, tolerance, 3)
        if plane is not None:
            central, on = (np.count_nonzero(some.on(plane[None], part)) for part in (tolerance / 2, tolerance))
            if 2 * central - on > most:
                best, most = plane, 2 * central - on
    return None if best is None else _fitted_within(points, best, tolerance, least)


def _fitted_within(points: SurfacePoints, plane: np.ndarray, tolerance: float, least: float) -> np.ndarray | None:
    """A plane fitted to the points that are on it, within TOLERANCE first and then within a smaller `tolerance`; None
    if they are fewer than `least`."""
    for step in range(FITS):
        on = points.on(plane[None], max(TOLERANCE / 2**step, tolerance))[:, 0]
        if np.count_nonzero(on) < least:
            return None
        plane = _fitted(points[on])
    return plane if np.count_nonzero(points.on(plane[None], tolerance)) >= least else None


def _fitted(points: SurfacePoints) -> np.ndarray:
    """The plane (4,) nearest to points, of which the far ones are less exact."""
    weight = 1 / np.maximum(np.linalg.norm(points.position - points.center, axis=1), 1e-12)
    middle = np.average(points.position, axis=0, weights=weight**2)
    scaled = (points.position - middle) * weight[:, None]
    normal = np.linalg.eigh(scaled.T @ scaled)[1][:, 0]
    return np.append(normal, normal @ middle)


def point_plane_depth(found: DepthMap, confirmed: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """(H, W) float32 depth of the planes that most depths around lie on, NaN elsewhere.

    Pixels with a confirmed depth are on a plane if stereo cannot tell it from that depth: nearly all confirmed depths
    around are on it, and are off by less, in the mean, than they deviate from those of neighbours. Relief stays.

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
        off_plane = np.where(known & (by_plane > 0), by_plane * own - 1, 1)
        on = (np.abs(off_plane) < TOLERANCE) & (np.abs(found.normal @ plane[:3]) > SAME_NORMAL)
        if on.any():
            share = _mean_around(on)
            better = share > most
            most[better], inverse[better], off[better] = share[better], by_plane[better], off_plane[better]
    sure, on = np.isfinite(confirmed), np.abs(off) < TOLERANCE
    on_sure = on & sure
    nearly_all = _mean_around(on_sure) >= NEARLY_ALL * _mean_around(sure)
    error, deviation = (_mean_around(np.where(on_sure, image, 0)) for image in (off, found.deviation))
    alike = np.abs(error) <= UNTOLD * deviation
    taken = np.where(sure, on & nearly_all & alike, most > ON_SHARE)
    with np.errstate(divide="ignore"):
        return np.where(taken, 1 / inverse, np.nan).astype(np.float32)


def _mean_around(image: np.ndarray) -> np.ndarray:
    return uniform_filter(image.astype(np.float64), WINDOW, mode="constant")
