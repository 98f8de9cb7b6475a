"""Estimate the noise of photographs: from their own pixels, and from differences between photographs of the same
surface.

A single photograph does not tell noise from fine texture, such as that of a carpet all over it. Two photographs have
texture in common, but not noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.sampling import sample_bilinear
from linprim_geo.stereo.evidence import CONFIRMED_DEPTH

# The least variance of noise: that of rounding grey values.
LEAST_NOISE = 1.0
# At least this share of a photograph is assumed to be plain, or nearly so. There the variance of 3 by 3 pixels is that
# of the noise times chi-square of 8 degrees of freedom over 9, whose tenth percentile is 3.49.
PLAIN_SHARE, LEAST_OF_PLAIN = 0.1, 3.49 / 9
DARKEST, BRIGHTEST = 3, 252
# Windows of a photograph compared with another one, and the fewest of them that count: a tenth of 300 variances with 8
# degrees of freedom is known within a tenth.
WINDOWS, LEAST_WINDOWS = 4000, 300
# Offsets (row, column) of the pixels of a window from its middle.
WINDOW = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij"), axis=-1).reshape(-1, 2)


def noise_of(grey: np.ndarray) -> float:
    """Return the variance of the noise of (H, W) grey values, at least LEAST_NOISE: from the median absolute second
    difference along both axes, from which planes and edges along either axis cancel. Source: Immerkaer 1996, with the
    median instead of the mean."""
    g = grey.astype(np.float32)
    across = g[:, :-2] - 2 * g[:, 1:-1] + g[:, 2:]
    both = across[:-2] - 2 * across[1:-1] + across[2:]
    return max(LEAST_NOISE, float(np.median(np.abs(both)) / 0.6745) ** 2 / 36)


def plainest(values: np.ndarray, grey: np.ndarray) -> float:
    """Return the quantile PLAIN_SHARE of values, without black and white pixels: clipped ones have no noise."""
    varying = values[_may_vary(grey)]
    return float(np.quantile(varying, PLAIN_SHARE)) if len(varying) else 0.0


def _may_vary(grey: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: pixels that are neither black nor white."""
    return (grey > DARKEST) & (grey < BRIGHTEST)


def shared_noise(
    cameras: Sequence[Camera],
    greys: Sequence[np.ndarray],
    depths: Sequence[np.ndarray],
    sources: Sequence[Sequence[int]],
) -> list[float]:
    """Return for each photograph an upper bound of the variance of its noise, at least LEAST_NOISE; infinite where none
    of its `sources`, numbers of photographs, shows enough of the same surfaces.

    `greys` (H, W) uint8; `depths` (H, W), NaN where unknown. The bound is the variance over 3 by 3 pixels of the
    difference to the other photograph at the same surface, in the plainest tenth of windows, for the source view that
    differs least. It contains the noise of both photographs, that of the other reduced by interpolation, and texture
    displaced by errors of depth.
    """
    rng, result = np.random.default_rng(0), []
    for camera, grey, depth, others in zip(cameras, greys, depths, sources, strict=True):
        windows, points = _windows(camera, grey, depth, rng)
        least = min((_difference(windows, points, cameras[k], greys[k], depths[k]) for k in others), default=np.inf)
        result.append(max(LEAST_NOISE, least))
    return result


def _windows(camera: Camera, grey: np.ndarray, depth: np.ndarray, rng) -> tuple[np.ndarray, np.ndarray]:
    """Return (N, 9) grey values of random windows with known depths whose middles are not clipped, and their (N, 9, 3)
    points."""
    known = np.isfinite(depth) & _may_vary(grey)
    known[[0, -1]] = known[:, [0, -1]] = False
    middles = np.unravel_index(rng.permutation(np.flatnonzero(known))[:WINDOWS], known.shape)
    row, column = (middle[:, None] + steps for middle, steps in zip(middles, WINDOW.T, strict=True))
    whole = np.isfinite(depth[row, column]).all(1)
    row, column = row[whole], column[whole]
    return grey[row, column], camera.center + camera.world_rays()[row, column] * depth[row, column][..., None]


def _difference(windows: np.ndarray, points: np.ndarray, other: Camera, grey: np.ndarray, depth: np.ndarray) -> float:
    """Return the bound of `shared_noise` from one view `other`; infinite if it shows too few of the (N, 9) windows,
    given their (N, 9, 3) points."""
    pixels, away = other.project(points.reshape(-1, 3))
    seen = other.shows(pixels, away)
    column, row = np.where(seen, pixels.T, 0).astype(np.int64)
    with np.errstate(invalid="ignore"):
        seen &= np.abs(depth[row, column] / away - 1) < CONFIRMED_DEPTH
    seen = seen.reshape(windows.shape).all(1)
    if np.count_nonzero(seen) < LEAST_WINDOWS:
        return np.inf
    there = sample_bilinear(grey.astype(np.float32), pixels.reshape(*windows.shape, 2)[seen])[..., 0]
    return float(np.quantile((windows[seen] - there).var(1), PLAIN_SHARE)) / LEAST_OF_PLAIN
