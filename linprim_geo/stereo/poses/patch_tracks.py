"""Track points of surfaces in photographs to some hundredths of a pixel, by alignment of image patches.

Patches lie on planes that stereo of small copies finds, and are shifted in other photographs until they look the same.
Keypoints are precise to a third of a pixel, and a wall with weak texture has few; a patch with any texture is precise
up to its noise, along the directions in which it varies. Source: Lucas and Kanade 1981; Baker and Matthews,
Lucas-Kanade 20 Years On, 2004 (forward additive); patches on planes: Furukawa and Ponce, Accurate Camera Calibration
from Multi-View Stereo and Bundle Adjustment, 2009.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter, sobel

from linprim_geo.capture.small_copy import SmallCopy
from linprim_geo.capture.types import View
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.feature_points import ObservedPoints
from linprim_geo.geometry.sampling import sample_bilinear
from linprim_geo.points.view_pairs import visible_pixels
from linprim_geo.stereo.depth_maps import DepthMap, depth_maps, grey_of, inverse_planes
from linprim_geo.stereo.noise import noise_of
from linprim_geo.stereo.surface_points import LONGER_SIDE as LONGER_SIDE_OF_DEPTHS

# The longest side in pixels to which photographs are averaged down, and how many of them, decoded, are kept in memory.
LONGER_SIDE, IN_MEMORY = 1000, 32
# Patches per photograph, evenly spread, and the nearest other photographs in which each is searched.
PATCHES, OTHERS = 200, 10
# Pixels from the centre of a patch to its border; the sigma of its weights, as a share of that; and the sigma in pixels
# by which grey values are smoothed, so that gradients show where a patch has to move.
RADIUS, WEIGHTED, SMOOTHED = 6, 0.6, 0.7
# The least texture of a patch: the larger eigenvalue of the mean structure tensor, in variances of the noise.
LEAST_TEXTURE = 1.0
# A pixel of the small depth map is an inlier of a patch's plane within the share ON_PLANE; at most MOST_OFF of those
# around a patch may be unknown or outliers.
ON_PLANE, MOST_OFF = 0.01, 0.3
# Another view shows a patch if its depth agrees up to this share, as poses still have errors.
SAME_DEPTH = 0.02
# The number of steps; the largest last step, and the largest total shift along each axis, in pixels; and the least
# correlation of matched patches.
STEPS, CONVERGED, LARGEST_SHIFT, ALIKE = 8, 0.1, 3.0, 0.8
# This many variances of the noise are added to mean squares of gradients: more than noise alone gives them, so that
# patches without texture take short steps.
DAMPED = 0.08
# The least error of a patch in pixels: planes are curved, and lighting changes.
LEAST_ERROR = 0.05
# The least number of photographs that see a point.
LEAST_TRACK = 3


@dataclass(frozen=True)
class _Image:
    """A smoothed photograph and its gradients, (H, W) float32, and the variance of its noise before smoothing."""

    grey: np.ndarray
    by_x: np.ndarray
    by_y: np.ndarray
    noise: float

    @staticmethod
    def of(view: View) -> _Image:
        grey = grey_of(view.load().rgb)
        smooth = gaussian_filter(grey.astype(np.float32), SMOOTHED)
        return _Image(smooth, sobel(smooth, 1) / 8, sobel(smooth, 0) / 8, noise_of(grey))


@dataclass(frozen=True)
class _Patches:
    """The patches of a photograph: their centres `middle` (P, 2) in pixels, `points` (P, S, 3) of the world at their
    samples, and `values` (P, S), normalised for lighting, of mean square 1."""

    middle: np.ndarray
    points: np.ndarray
    values: np.ndarray


def small_depth_maps(views: Sequence[View], points: np.ndarray, *, seed: int = 0) -> list[DepthMap]:
    """Return depth maps of small copies of the photographs.

    Args:
        views: photographs whose poses are nearly right.
        points: (P, 3) of the scene, as for `depth_maps`.

    Raises:
        LinprimError: as `depth_maps`.
    """
    return depth_maps([SmallCopy.within(view, LONGER_SIDE_OF_DEPTHS) for view in views], points, fit=False, seed=seed)


def patch_tracks(views: Sequence[View], maps: Sequence[DepthMap]) -> ObservedPoints:
    """Return tracks of surface points: each `pixel` in the photographs at full size, and its `precision`.

    Args:
        views: photographs whose poses are nearly right.
        maps: their `small_depth_maps`.
    """
    copies = [SmallCopy.within(view, LONGER_SIDE) for view in views]
    image = lru_cache(IN_MEMORY)(lambda number: _Image.of(copies[number]))
    centers = np.array([view.camera.center for view in views])
    exact = np.eye(2) / LEAST_ERROR
    seen: list[tuple[np.ndarray, ...]] = [(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), np.zeros((0, 2, 2)))]
    places, count = [np.zeros((0, 3))], 0
    for number, copy in enumerate(copies):
        patches = _patches(image(number), copy, maps[number])
        own = np.arange(len(patches.middle))
        here = np.tile(exact / copy.factor, (len(own), 1, 1))
        found = [(own, np.full(len(own), number), patches.middle * copy.factor, here)]
        nearest = np.argsort(np.linalg.norm(centers - centers[number], axis=1), kind="stable")
        for other in [k for k in nearest[: OTHERS + 1] if k != number]:
            rows = _showing(maps[other], patches)
            kept, pixel, precision = _matched(patches, rows, image(other), copies[other].camera)
            factor = copies[other].factor
            found.append((kept, np.full(len(kept), other), pixel * factor, precision / factor))
        rows, *rest = (np.concatenate(column) for column in zip(*found, strict=True))
        often = np.bincount(rows, minlength=len(own)) >= LEAST_TRACK
        row_of = np.cumsum(often) - 1 + count
        taken = often[rows]
        seen.append((row_of[rows[taken]], *(column[taken] for column in rest)))
        places.append(patches.points[often, _middle()])
        count += np.count_nonzero(often)
    columns = [np.concatenate(column) for column in zip(*seen, strict=True)]
    order = np.argsort(columns[0], kind="stable")
    nothing = np.zeros((count, 3), np.uint8), np.zeros(count, np.float32)
    return ObservedPoints(np.concatenate(places), *nothing, *(column[order] for column in columns))


@lru_cache
def _offsets() -> tuple[np.ndarray, np.ndarray]:
    """Return the (S, 2) offsets of the samples from the centre of a patch in pixels, and their (S,) weights, whose sum
    is 1."""
    along = np.arange(-RADIUS, RADIUS + 1.0)
    offset = np.stack(np.meshgrid(along, along), -1).reshape(-1, 2)
    weight = np.exp(-0.5 * (offset**2).sum(1) / (WEIGHTED * RADIUS) ** 2)
    return offset, weight / weight.sum()


def _middle() -> int:
    return len(_offsets()[0]) // 2


@lru_cache
def _light() -> np.ndarray:
    """Return (S, 3) basis functions of lighting, of mean square 1: a constant for exposure, and slopes along x and y
    for vignetting and shading."""
    offset, weight = _offsets()
    basis = np.column_stack([np.ones(len(offset)), offset])
    return basis / np.sqrt(weight @ basis**2)  # orthogonal, as the window is symmetric


def _without_light(values: np.ndarray) -> np.ndarray:
    """Return (P, S) values less their weighted mean and slopes."""
    return values - (values * _offsets()[1]) @ _light() @ _light().T


def _patches(image: _Image, copy: SmallCopy, found: DepthMap) -> _Patches:
    """Return the patches with texture that lie on planes of a small depth map."""
    camera, offset = copy.camera, _offsets()[0]
    scale = found.camera.fx / camera.fx  # not the ratio of widths, as remaining columns are cut off
    planes = inverse_planes(found.camera, found.depth, found.normal @ camera.rotation.T)
    middle = _textured(image, _flat(found.is_confirmed(), planes, camera, scale))
    small = (middle * scale).astype(int)
    inverse, by_x, by_y = planes[:, small[:, 1], small[:, 0]].astype(np.float64)
    pixel = middle[:, None] + offset
    from_small = pixel * scale - (small[:, None] + 0.5)
    inverse = inverse[:, None] + by_x[:, None] * from_small[..., 0] + by_y[:, None] * from_small[..., 1]
    kept = (inverse > 0).all(1)
    middle, pixel, inverse = middle[kept], pixel[kept], inverse[kept]
    ray = np.concatenate([(pixel - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones_like(pixel[..., :1])], -1)
    values = _without_light(sample_bilinear(image.grey, pixel)[..., 0])
    square = _mean(values**2)
    return _Patches(
        middle, camera.center + (ray / inverse[..., None]) @ camera.rotation, values / np.sqrt(square)[:, None]
    )


def _flat(known: np.ndarray, planes: np.ndarray, camera: Camera, scale: float) -> np.ndarray:
    """Return (H, W) bool for a camera's pixels: centres of patches that lie on one of the `planes` (3, h, w) of a depth
    map, which is smaller by `scale` and partly `known` (h, w)."""
    inverse, by_x, by_y = planes
    height, width = known.shape
    reach = int(np.ceil(RADIUS * scale))
    padded = np.pad(np.where(known, inverse, np.float32(np.nan)), reach, constant_values=np.nan)
    on_plane = np.zeros(known.shape, int)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            there = padded[reach + dy : reach + dy + height, reach + dx : reach + dx + width]
            with np.errstate(invalid="ignore", divide="ignore"):
                on_plane += np.abs(there / (inverse + dx * by_x + dy * by_y) - 1) < ON_PLANE
    flat = known & (on_plane >= (1 - MOST_OFF) * (2 * reach + 1) ** 2)
    row, column = (((np.arange(count) + 0.5) * scale).astype(int) for count in (camera.height, camera.width))
    within = np.zeros((camera.height, camera.width), bool)
    within[np.ix_(row < height, column < width)] = flat[np.ix_(row[row < height], column[column < width])]
    return within


def _textured(image: _Image, allowed: np.ndarray) -> np.ndarray:
    """Return (P, 2) centres of patches: in each of PATCHES equal cells, of the (H, W) `allowed` pixels, the one whose
    patch is best localised by its texture."""
    xx, xy, yy = (
        gaussian_filter(a * b, RADIUS / 2)
        for a, b in ((image.by_x, image.by_x), (image.by_x, image.by_y), (image.by_y, image.by_y))
    )
    middle, spread = (xx + yy) / 2, np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    border = RADIUS + 1
    inside = np.zeros(allowed.shape, bool)
    inside[border:-border, border:-border] = True
    taken = allowed & inside & (middle + spread > LEAST_TEXTURE * image.noise)
    # An edge counts, a corner ten times as much.
    score = np.where(taken, (middle - spread) + 0.1 * (middle + spread), 0)
    height, width = score.shape
    side = max(1, int(np.sqrt(height * width / PATCHES)))
    cells = np.pad(score, ((0, -height % side), (0, -width % side)))
    rows, columns = cells.shape[0] // side, cells.shape[1] // side
    cells = cells.reshape(rows, side, columns, side).swapaxes(1, 2).reshape(rows * columns, side * side)
    best = cells.argmax(1)
    cell = np.flatnonzero(cells[np.arange(len(cells)), best] > 0)
    row = cell // columns * side + best[cell] // side
    column = cell % columns * side + best[cell] % side
    return np.stack([column, row], 1) + 0.5


def _showing(found: DepthMap, patches: _Patches) -> np.ndarray:
    """Return the indices of the patches that another view shows, according to its small depth map."""
    inside, pixel, depth = visible_pixels(found.camera, patches.points[:, _middle()])
    same = np.abs(found.depth[pixel[:, 1], pixel[:, 0]] / depth - 1) < SAME_DEPTH
    return np.flatnonzero(inside)[same]


def _matched(
    patches: _Patches, rows: np.ndarray, image: _Image, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Align `rows` of patches with another photograph. Return those found, their (Q, 2) pixels, and (Q, 2, 2)
    precisions (square roots of inverse covariances)."""
    weight = _offsets()[1]
    samples = len(weight)
    seen, depth = camera.project(patches.points[rows].reshape(-1, 3))
    front = (depth.reshape(-1, samples) > 0).all(1)
    rows, seen = rows[front], seen.reshape(-1, samples, 2)[front]
    shift = np.zeros((len(rows), 2))
    for _ in range(STEPS):
        at = seen + shift[:, None]
        value, by_x, by_y = (
            _without_light(sample_bilinear(each, at)[..., 0]) for each in (image.grey, image.by_x, image.by_y)
        )
        size = np.sqrt(np.maximum(_mean(value**2), 1e-6))[:, None]
        by_x, by_y, miss = by_x / size, by_y / size, patches.values[rows] - value / size
        noise = image.noise / size[:, 0] ** 2
        damping = DAMPED * noise
        xx, xy, yy = _mean(by_x**2) + damping, _mean(by_x * by_y), _mean(by_y**2) + damping
        right = np.stack([_mean(by_x * miss), _mean(by_y * miss)], 1)
        matrix = np.stack([xx, xy, xy, yy], 1).reshape(-1, 2, 2)
        step = np.linalg.solve(matrix, right[..., None])[..., 0]
        shift += np.clip(step, -1, 1)
    square = _mean(miss**2)
    still = (np.linalg.norm(step, axis=1) <= CONVERGED) & (np.abs(shift) <= LARGEST_SHIFT).all(1)
    good = still & (1 - square / 2 > ALIKE)
    matrix, square, noise, damping = matrix[good], square[good], noise[good], damping[good]
    # The covariance of least squares, after subtracting the gradients that noise itself causes.
    own, axes = np.linalg.eigh(matrix - damping[:, None, None] * np.eye(2))
    told = np.maximum(own - 2 * _gradient_noise() * noise[:, None], 1e-9)
    independent = 0.5 / (weight**2).sum()  # smoothing correlates neighbours
    variance = (square / independent)[:, None] / told + LEAST_ERROR**2
    precision = (axes / np.sqrt(variance)[:, None]) @ axes.swapaxes(1, 2)
    return rows[good], (seen[:, samples // 2] + shift)[good], precision


def _mean(values: np.ndarray) -> np.ndarray:
    """Return (P,) weighted means of (P, S)."""
    return values @ _offsets()[1]


@lru_cache
def _gradient_noise() -> float:
    """Return the mean square of the gradients of smoothed noise of variance 1."""
    impulse = np.zeros((31, 31), np.float32)
    impulse[15, 15] = 1
    return float(((sobel(gaussian_filter(impulse, SMOOTHED), 1) / 8) ** 2).sum())
