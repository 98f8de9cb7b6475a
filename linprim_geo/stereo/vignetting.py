"""Estimate vignetting, the darkening of photographs away from the centre, from points that several of them show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import uniform_filter

from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.sampling import sample_bilinear
from linprim_geo.points.initial_points import in_image
from linprim_geo.stereo.evidence import CONFIRMED_DEPTH

# Each view is compared with the views so many places after it, at POINTS points, by means over BOX by BOX pixels.
STEPS, POINTS, BOX = (1, 2, 4, 8), 2000, 3
# The fewest common points of a pair, and the fewest pairs.
LEAST_POINTS, LEAST_PAIRS = 50, 3
# Grey values outside of these are clipped, or too noisy for a logarithm.
DARKEST, BRIGHTEST = 20, 245
# Rounds of robust reweighting, in which residuals above OUTLIER deviations lose weight: glossy paint, and wrong depths.
ROUNDS, OUTLIER = 5, 2.0
# The result is used if it exceeds CERTAIN standard errors, and the brightness of corners relative to the centre is
# within CORNERS: cos^4 of 45 degrees, and a correction that overshoots. What only the centre shows does not fix the
# corners.
CERTAIN, CORNERS = 3.0, (0.25, 1.1)


def radius_square(camera: Camera, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the squared distance of pixel positions from the optical axis, 1 in the corner of an image centred on
    it."""
    return ((x - camera.cx) ** 2 + (y - camera.cy) ** 2) / (0.25 * (camera.width**2 + camera.height**2))


def falloff(camera: Camera, law: np.ndarray) -> np.ndarray:
    """Return the (H, W) factor by which vignetting, as `vignetting` returns it, multiplies grey values."""
    square = radius_square(camera, np.arange(camera.width) + 0.5, np.arange(camera.height)[:, None] + 0.5)
    return np.exp(law[0] * square + law[1] * square**2)


def vignetting(cameras: Sequence[Camera], greys: Sequence[np.ndarray], depths: Sequence[np.ndarray]) -> np.ndarray:
    """Return (2,) a and b: grey values are multiplied by exp(a s + b s^2), with s of `radius_square`; zeros if that is
    not significant.

    A point on a matt surface is equally bright in all photographs, apart from a gain per pair. The remaining difference
    depends on its position in the images. Fitted by weighted least squares of logarithms, gains eliminated.

    Args:
        greys: (H, W) of each view, gamma-encoded: a power of brightness only changes a and b.
        depths: (H, W) confirmed depth of each view, NaN elsewhere.
    """
    smooth: dict[int, np.ndarray] = {}  # of the views that are being compared
    pairs = []
    for one in range(len(cameras)):
        rows, columns = np.nonzero(np.isfinite(depths[one]))
        step = max(1, len(rows) // POINTS)
        rows, columns = rows[::step], columns[::step]
        rays = cameras[one].world_rays()[rows, columns]
        points = cameras[one].center + rays * depths[one][rows, columns, None]
        for other in (one + step for step in STEPS if one + step < len(cameras)):
            for view in (one, other):
                if view not in smooth:
                    smooth[view] = uniform_filter(greys[view].astype(np.float32), BOX, mode="nearest")
            pair = _pair(cameras, smooth, depths, one, other, (rows, columns), points)
            if len(pair) >= LEAST_POINTS:
                pairs.append(pair)
        smooth.pop(one, None)
    if len(pairs) < LEAST_PAIRS:
        return np.zeros(2)
    weights = [np.ones(len(pair)) for pair in pairs]
    for _ in range(ROUNDS):
        centered = [_centered(pair, weight) for pair, weight in zip(pairs, weights, strict=True)]
        found, error = _least_squares(centered, weights)
        left = [pair[:, 0] - pair[:, 1:] @ found for pair in centered]
        deviation = 1.4826 * np.median(np.abs(np.concatenate(left)))
        weights = [np.minimum(1, OUTLIER * deviation / np.maximum(np.abs(each), 1e-9)) for each in left]
    certain = abs(found.sum()) > CERTAIN * error and CORNERS[0] < np.exp(found.sum()) < CORNERS[1]
    return found if certain else np.zeros(2)


def _pair(cameras, greys, depths, one, other, at, points) -> np.ndarray:
    """Return (P, 3) for points that two views show: the differences of log grey value, s and s^2."""
    inside, row, column = in_image(cameras[other], points)
    pixels, depth = cameras[other].project(points)
    with np.errstate(invalid="ignore"):
        good = np.flatnonzero(inside & (np.abs(depths[other][row, column] / depth - 1) < CONFIRMED_DEPTH))
    here = np.stack([at[1][good], at[0][good]], 1) + 0.5
    first = greys[one][at[0][good], at[1][good]]
    second = sample_bilinear(greys[other][..., None], pixels[good])[:, 0]
    usable = (np.minimum(first, second) > DARKEST) & (np.maximum(first, second) < BRIGHTEST)
    a, b = radius_square(cameras[one], *here[usable].T), radius_square(cameras[other], *pixels[good][usable].T)
    return np.stack([np.log(first[usable] / second[usable]), a - b, a**2 - b**2], 1)


def _centered(pair: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the rows of a pair less their weighted mean, which eliminates its gain."""
    return pair - np.average(pair, axis=0, weights=weight)


def _least_squares(pairs: Sequence[np.ndarray], weights: Sequence[np.ndarray]) -> tuple[np.ndarray, float]:
    """Return the two factors, and the standard error of their sum from the scatter between pairs, as errors within a
    pair are correlated."""
    normal = [(pair[:, 1:] * w[:, None]).T @ pair[:, 1:] for pair, w in zip(pairs, weights, strict=True)]
    right = [(pair[:, 1:] * w[:, None]).T @ pair[:, 0] for pair, w in zip(pairs, weights, strict=True)]
    inverse = np.linalg.pinv(np.sum(normal, 0))
    found = inverse @ np.sum(right, 0)
    scatter = sum(np.outer(r - n @ found, r - n @ found) for n, r in zip(normal, right, strict=True))
    return found, float(np.sqrt(np.ones(2) @ inverse @ scatter @ inverse @ np.ones(2)))
