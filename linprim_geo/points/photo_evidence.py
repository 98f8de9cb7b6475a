"""Measure how a scene was photographed from points seen in many views: exposure gains, view-dependent colour, pixel
size.

Needs no trained model or reference surface. Points may be occluded in views that they project into, so everything that
is summed over views is a median or trimmed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from linprim_geo.capture.types import Scene
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.sampling import sample_bilinear
from linprim_geo.points.initial_points import SmallView, VolumePoints, evenly_spread_views, in_image, local_planes

# Largest numbers of points and views used; more only take time.
POINTS, VIEWS = 2500, 60
# A point is occluded in a view if one of its _NEIGHBOURS nearest points in the image, within _HIDDEN_REACH of the
# image's longer side, lies in front of the point's plane by at least _HIDDEN_BEFORE of its depth.
_HIDDEN_REACH, _HIDDEN_BEFORE, _NEIGHBOURS = 0.04, 0.02, 12
# A point is used if its neighbours are at least this flat (`local_planes`), in views that see its plane at less than 66
# degrees from its normal.
_FLAT, _LEAST_COSINE = 0.4, 0.4
# A colour is the mean of 5x5 pixels whose standard deviation is below _PLAIN (colours in [0, 1]). Other patches are
# skipped, because edges fall differently in each view.
_PATCH, _PLAIN = 5, 0.06
# Range of colours, in [0, 1], that are neither black nor clipped at white.
_DARKEST, _BRIGHTEST = 0.06, 0.97
# Smallest number of views of a point, and of points, for fitting colour over directions or measuring scale.
_LEAST_VIEWS, _LEAST_POINTS = 5, 30
# Colour residuals, in [0, 1], above this come from something else in front of the point.
_SOMETHING_ELSE = 0.25
# For trimmed means, one value in this many is left out at each end.
_EXTREME = 20
_GAIN_ROUNDS = 15
# Regularisation towards a gain of 1, in numbers of points, for photographs that share few points with others.
_GAIN_PRIOR = 0.1
# Smallest distance between neighbours in pixels, so that their colour patches do not overlap.
_NEIGHBOUR_PX = 7


@dataclass(frozen=True)
class Observations:
    """Observations of P points `xyz` (P, 3) in V views.

    `seen` (P, V) bool. Where `seen`: `footprint` (P, V), the length that a pixel of the photograph covers at the point.
    `plain` (P, V) bool, a subset of `seen`: the surroundings are uniform. Where `plain`: `color` (P, V, 3) float64 in
    [0, 1].
    """

    xyz: np.ndarray
    seen: np.ndarray
    plain: np.ndarray
    color: np.ndarray
    footprint: np.ndarray

    @cached_property
    def log_gains(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the (V, 3) log gains of the photographs, with mean 0 per channel, and (V, 3) their standard errors.

        log colour = log gain of the view + log colour of the point, solved for all at once by least squares with Cauchy
        weights. A view that shows fewer than 30 usable points has a log gain of 0 and an infinite error.
        """
        gains, errors = np.zeros((self.seen.shape[1], 3)), np.full((self.seen.shape[1], 3), np.inf)
        for channel in range(3):
            color = self.color[..., channel]
            usable = self.plain & (color > _DARKEST) & (color < _BRIGHTEST)
            # Generally dark points are dropped: above the threshold only those of their colours would remain that
            # something made brighter.
            usable &= (_median(np.where(self.plain, color, np.nan), 1) > 2 * _DARKEST)[:, None]
            usable &= (usable.sum(0) >= _LEAST_POINTS)[None]
            usable &= (usable.sum(1) >= 2)[:, None]
            known = usable.any(0)
            if known.sum() < 2:
                continue
            rows = usable.any(1)
            gains[known, channel], errors[known, channel] = _view_offsets(
                np.log(np.where(usable, color, 1.0))[rows][:, known], usable[rows][:, known]
            )
        return gains, errors

    @property
    def gains(self) -> np.ndarray:
        """Return the (V, 3) gains of the photographs, with geometric mean 1 per channel."""
        return np.exp(self.log_gains[0])

    @property
    def gain_spread(self) -> float | None:
        """Return the standard deviation of the log gains over the photographs, minus the variance due to estimation
        errors, for the channel where it is largest; None if fewer than three photographs share points.

        The most extreme of each 20 photographs (at least one) is left out, because a highlight may have caused it.
        """
        gains, error = self.log_gains
        spreads = []
        for channel in range(3):
            known = np.isfinite(error[:, channel])
            if known.sum() >= 3:
                middle = np.abs(gains[known, channel] - np.median(gains[known, channel]))
                usual = np.argsort(middle, kind="stable")[: max(2, known.sum() - max(1, known.sum() // 20))]
                values, errors = gains[known, channel][usual], error[known, channel][usual]
                spreads.append(np.sqrt(max(values.var() - np.mean(errors**2), 0.0)))
        return float(max(spreads)) if spreads else None

    @property
    def view_dependence(self) -> float | None:
        """Return by how much the points' colour, in [0, 1], changes with viewing direction after removing gains; None
        without enough views.

        The deviation of a colour from the point's median is multiplied by the deviation of a neighbouring point, some
        pixels away, in the same view. Noise and texture finer than a pixel are uncorrelated between neighbours;
        highlights and reflections are correlated. The result is the root of the mean product, without the largest and
        smallest twentieth: the few products where something else occludes both points are large.
        """
        from scipy.spatial import cKDTree

        color = self.color / self.gains[None]
        usable = self.plain & (self.color > 0).all(2)
        middle = _median(np.where(usable[..., None], color, np.nan), 1)
        rest = np.nan_to_num(color - middle[:, None])
        usable &= (np.abs(rest) < _SOMETHING_ELSE).all(2) & (usable.sum(1) >= _LEAST_VIEWS)[:, None]
        if usable.any(1).sum() < _LEAST_POINTS:
            return None
        apart = _NEIGHBOUR_PX * _median(np.where(usable, self.footprint, np.nan), 1)
        distance, near = cKDTree(self.xyz).query(self.xyz, k=min(_NEIGHBOURS * 4, len(self.xyz)))
        far_enough = distance > apart[:, None]
        first = far_enough.argmax(1)
        rows = np.arange(len(near))
        other = near[rows, first]
        both = usable & usable[other] & (far_enough.any(1) & (distance[rows, first] < 4 * apart))[:, None]
        if both.sum() < _LEAST_POINTS * _LEAST_VIEWS:
            return None
        shared = np.sort((rest * rest[other]).mean(2)[both])
        trimmed = shared[len(shared) // _EXTREME : len(shared) - len(shared) // _EXTREME]
        return float(np.sqrt(max(trimmed.mean(), 0.0)))

    @property
    def scale_ratio(self) -> float | None:
        """Return the 75th percentile, over points, of the largest divided by the smallest pixel footprint over the
        views that see the point; None without enough points."""
        footprint = np.where(self.seen, self.footprint, np.nan)
        rows = self.seen.sum(1) >= 3
        if rows.sum() < _LEAST_POINTS:
            return None
        low, high = np.nanmin(footprint[rows], 1), np.nanmax(footprint[rows], 1)
        return float(np.percentile(high / low, 75))


def observe(scene: Scene, seed: int = 0, views: int = VIEWS) -> Observations | None:
    """Observe the scene's points in at most `views` of its training photographs, evenly spread; None if there are no
    points on surfaces.

    A view sees a point if the point lies in its image, on the foreground if there is one, is not occluded by other
    points, and is seen from the front. The front is the side of the plane through its neighbours from which the
    photographs show the point's colour.
    """
    cloud = scene.points
    if cloud is None or isinstance(cloud, VolumePoints) or len(cloud.xyz) < _LEAST_POINTS:
        return None
    small_views = evenly_spread_views(scene.train, views)
    rng = np.random.default_rng([seed, 11])
    normal, flat = _normals(cloud.xyz, seed)
    good = np.flatnonzero(flat < _FLAT)
    if cloud.error_px is not None and len(good):
        good = good[cloud.error_px[good] <= np.percentile(cloud.error_px[good], 75)]
    if len(good) < _LEAST_POINTS:
        return None
    rows = np.sort(rng.choice(good, min(POINTS, len(good)), replace=False))
    xyz, normal = cloud.xyz[rows], normal[rows]
    count = (len(rows), len(small_views))
    seen, plain = np.zeros(count, bool), np.zeros(count, bool)
    color, footprint = np.zeros((*count, 3)), np.ones(count)
    towards = np.stack([small_view.camera.center - xyz for small_view in small_views], 1)
    towards /= np.maximum(np.linalg.norm(towards, axis=2, keepdims=True), np.finfo(float).tiny)
    cosine = np.einsum("pvc,pc->pv", towards, normal)
    for index, (small_view, camera) in enumerate(zip(small_views, _same_views(scene, small_views), strict=True)):
        facing = np.sign(cosine[:, index])[:, None] * normal
        seen[:, index], plain[:, index], color[:, index], depth = _colors_in(small_view, cloud.xyz, rows, facing)
        footprint[:, index] = np.where(depth > 0, depth, 1.0) / max(camera.fx, camera.fy)
    difference = np.abs(color - cloud.rgb[rows][:, None] / 255.0).mean(2)
    unlike = []
    for sign in (1, -1):
        front = plain & (sign * cosine > _LEAST_COSINE)
        typical = _median(np.where(front, difference, np.nan), 1)
        unlike.append(np.where(front.any(1), typical, np.inf))
    side = np.where(unlike[0] <= unlike[1], 1, -1)
    seen &= side[:, None] * cosine > _LEAST_COSINE
    return Observations(xyz, seen, plain & seen, color, footprint)


def _same_views(scene: Scene, small_views: Sequence[SmallView]) -> list[Camera]:
    chosen = np.unique(np.linspace(0, len(scene.train) - 1, len(small_views)).round().astype(int))
    return [scene.train[i].camera for i in chosen]


def _colors_in(
    small_view: SmallView, xyz: np.ndarray, rows: np.ndarray, facing: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Sample the points `rows` of (N, 3) `xyz` in a view. `facing` (P, 3) are the normals of their planes, turned
    towards the view.

    Returns: (P,) whether the view sees them, (P,) whether their surroundings are also uniform, (P, 3) colours in [0,
    1], (P,) z-depths.
    """
    from scipy.ndimage import minimum_filter, uniform_filter
    from scipy.spatial import cKDTree

    inside = np.flatnonzero(in_image(small_view.camera, xyz)[0])
    pixels, depth = small_view.camera.project(xyz)
    seen = np.isin(rows, inside)
    if len(inside) > _NEIGHBOURS and seen.any():
        mine = rows[seen]
        distance, near = cKDTree(pixels[inside]).query(pixels[mine], k=_NEIGHBOURS + 1)
        close = distance <= _HIDDEN_REACH * max(small_view.camera.width, small_view.camera.height)
        before = np.einsum("pkc,pc->pk", xyz[inside][near] - xyz[mine][:, None], facing[seen])
        before = (before > _HIDDEN_BEFORE * depth[mine, None]) & (depth[inside][near] < depth[mine, None])
        seen[seen] = ~(close & before).any(1)
    places = np.where(seen[:, None], pixels[rows], 0.5)
    column, row = np.clip(places.astype(np.int64), 0, [small_view.camera.width - 1, small_view.camera.height - 1]).T
    image = small_view.rgb.astype(np.float64) / 255.0
    mean = uniform_filter(image, (_PATCH, _PATCH, 1), mode="nearest")
    variance = uniform_filter(image**2, (_PATCH, _PATCH, 1), mode="nearest") - mean**2
    plain = seen & (variance.max(2) < _PLAIN**2)[row, column]
    if small_view.foreground is not None:
        seen &= small_view.foreground[row, column]
        plain &= minimum_filter(small_view.foreground, size=_PATCH + 2, mode="nearest")[row, column]
    color = sample_bilinear(mean.astype(np.float32), places[None])[0].astype(np.float64)
    return seen, plain, color, depth[rows]


def _normals(xyz: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (P, 3) normals of the planes through the points' neighbours, of arbitrary sign, and (P,) how flat these
    are."""
    from scipy.spatial.transform import Rotation

    rotation, flat = local_planes(xyz, seed)
    return Rotation.from_quat(np.roll(rotation, -1, axis=1)).as_matrix()[:, :, 2], flat


def _view_offsets(values: np.ndarray, usable: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit (P, V) values = g of the view + a of the point where `usable`; return (V,) g with mean 0, and (V,) its
    standard errors."""
    views = values.shape[1]
    weight, scale = usable.astype(float), 0.0
    for _ in range(_GAIN_ROUNDS):
        total = np.maximum(weight.sum(1, keepdims=True), 1e-9)
        # The points' values are eliminated. The rest is a Laplacian over the views; fixing the mean makes it
        # invertible.
        matrix = np.diag(weight.sum(0)) - weight.T @ (weight / total)
        right = (weight * (values - (weight * values).sum(1, keepdims=True) / total)).sum(0)
        inverse = np.linalg.inv(matrix + _GAIN_PRIOR * np.eye(views) + np.full((views, views), 1.0))
        gains = inverse @ right
        gains -= gains.mean()
        rest = values - gains
        rest = rest - (weight * rest).sum(1, keepdims=True) / total
        scale = max(1.4826 * float(np.median(np.abs(rest[usable]))), 1e-4)
        weight = usable / (1 + (rest / (2 * scale)) ** 2)
    return gains, scale * np.sqrt(np.maximum(np.diag(inverse) - 1 / views**2, 0.0))


def _median(values: np.ndarray, axis: int) -> np.ndarray:
    """Return the median without NaN; NaN if all values are NaN."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.nanmedian(values, axis=axis)
