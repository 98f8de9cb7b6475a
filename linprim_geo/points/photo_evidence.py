"""What photographs and points say about how a scene was taken: the same points looked at from many views.

Nothing here needs a trained model or a reference surface. Points may be hidden in views that they project into, so
whatever is summed up over views is a median or is trimmed.
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

# So many points and views say enough; more only take time.
POINTS, VIEWS = 2500, 60
# A point is hidden in a view if one of its 12 nearest in the image, within this share of its longer side, lies before
# its plane by this share of its depth.
_HIDDEN_REACH, _HIDDEN_BEFORE, _NEIGHBOURS = 0.04, 0.02, 12
# Points count whose neighbours lie as flat as this, where their plane is seen under less than 66 degrees.
_FLAT, _LEAST_COSINE = 0.4, 0.4
# Colours are those of 5x5 pixels that differ by no more than this, of 1 (standard deviation): edges fall elsewhere in
# every view.
_PATCH, _PLAIN = 5, 0.06
# Colours, of 1, that are neither black nor cut at white.
_DARKEST, _BRIGHTEST = 0.06, 0.97
# Views that see a point, at least, for a fit of its colour over directions or of its scale.
_LEAST_VIEWS, _LEAST_POINTS = 5, 30
# Residuals beyond this, of 1, are something else in front of the point.
_SOMETHING_ELSE = 0.25
# One in so many is left out at either end of what is averaged.
_EXTREME = 20
_GAIN_ROUNDS = 15
# What holds the gain of photographs near 1 that share hardly anything with others, in points.
_GAIN_PRIOR = 0.1
# Neighbours are the nearest points farther apart than the patches that colours are taken from, in pixels.
_NEIGHBOUR_PX = 7


@dataclass(frozen=True)
class Observations:
    """P points `xyz` (P, 3) in V views. `seen` (P, V) bool; where it holds, `footprint` (P, V), the length that a
    pixel of the photograph covers there; where `plain` (P, V) holds, which is part of it, `color` (P, V, 3) float64 in
    [0, 1]."""

    xyz: np.ndarray
    seen: np.ndarray
    plain: np.ndarray
    color: np.ndarray
    footprint: np.ndarray

    @cached_property
    def log_gains(self) -> tuple[np.ndarray, np.ndarray]:
        """((V, 3) logarithm of how bright each photograph shows the points, (V, 3) its standard error), of mean 0 per
        channel.

        log colour = gain of the view + colour of the point, solved for all at once by least squares with Cauchy's
        weights. A view that shows fewer than 30 points has a gain of 0 and an infinite error.
        """
        gains, errors = np.zeros((self.seen.shape[1], 3)), np.full((self.seen.shape[1], 3), np.inf)
        for channel in range(3):
            color = self.color[..., channel]
            usable = self.plain & (color > _DARKEST) & (color < _BRIGHTEST)
            # Of points that are dark as a rule, those colours alone would be left that something made bright.
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
        """(V, 3) how bright each photograph shows the points, of geometric mean 1 per channel."""
        return np.exp(self.log_gains[0])

    @property
    def gain_spread(self) -> float | None:
        """Standard deviation over the photographs of the logarithm of their brightness, of the channel where it is
        largest, less what the estimate itself scatters; without the most extreme of 20, which a highlight may have.
        None if fewer than three share points."""
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
        """By how much of 1 the points' colour changes with the direction that they are seen from, gains removed; None
        without enough views.

        A colour's deviation from the point's median is multiplied by that of a neighbouring point in the same view,
        some pixels away: noise and texture finer than a pixel have no part that neighbours share, highlights and
        reflections have. The root of the mean without the largest and the smallest twentieth: few products are of
        something else in front of both points, but those are large.
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
        """Largest by smallest length that a pixel covers at a point, over the views that see it: what a quarter of the
        points exceed."""
        footprint = np.where(self.seen, self.footprint, np.nan)
        rows = self.seen.sum(1) >= 3
        if rows.sum() < _LEAST_POINTS:
            return None
        low, high = np.nanmin(footprint[rows], 1), np.nanmax(footprint[rows], 1)
        return float(np.percentile(high / low, 75))


def observe(scene: Scene, seed: int = 0, views: int = VIEWS) -> Observations | None:
    """Looks at the scene's points in at most `views` of its training photographs, evenly spread; None if there are no
    points on surfaces.

    A point is seen by a view in whose image it lies, on the foreground if there is one, where no other points are in
    front of it, and that does not look at it from behind: from the side of the plane through its neighbours on which
    photographs have its colour.
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
    """Of the points `rows` of (N, 3) `xyz` in a view, whose planes have the normals (P, 3) `facing` it: (P,) whether it
    sees them, (P,) whether also in plain surroundings, (P, 3) colours in [0, 1], (P,) z-depths."""
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
    """(P, 3) normals of the planes through the points' neighbours, of either sign, and (P,) how flat these are."""
    from scipy.spatial.transform import Rotation

    rotation, flat = local_planes(xyz, seed)
    return Rotation.from_quat(np.roll(rotation, -1, axis=1)).as_matrix()[:, :, 2], flat


def _view_offsets(values: np.ndarray, usable: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((V,) g, (V,) its standard error) of (P, V) values = g of the view + a of the point, where usable; g has mean
    0."""
    views = values.shape[1]
    weight, scale = usable.astype(float), 0.0
    for _ in range(_GAIN_ROUNDS):
        total = np.maximum(weight.sum(1, keepdims=True), 1e-9)
        # The points' own values are eliminated; what is left is a Laplacian over the views, fixed by the mean.
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
    """Median without NaN, NaN where there is nothing else."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.nanmedian(values, axis=axis)
