"""Numbers as colours: errors, depths, scales."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    pass


# --- colours ---------------------------------------------------------------------------------------------


def error_colors(share: np.ndarray) -> np.ndarray:
    """Colours for values in [0, 1] (clamped), (..., 3) uint8 sRGB: dark blue through green to light yellow.

    A straight line in CIE lightness L* from 15 to 92 with the hue turning from 290 to 100 degrees, so equal
    steps look equal, also in grey and to the colour-blind; chroma 55 at most, less where sRGB cannot show it.

    Source: CIE 15 (L*a*b*, white point D65) and IEC 61966-2-1 (sRGB).
    """
    share = np.clip(np.asarray(share, np.float64), 0.0, 1.0)
    table = _error_color_table()
    return table[np.floor(share * (len(table) - 1) + 0.5).astype(np.int64)]


@lru_cache
def _error_color_table(size: int = 256) -> np.ndarray:
    """(size, 3) uint8 sRGB of the line that `error_colors` describes."""
    share = np.linspace(0.0, 1.0, size)
    lightness, hue = 15.0 + 77.0 * share, np.radians(290.0 - 190.0 * share)
    low, high = np.zeros(size), np.full(size, 55.0)
    # Bisection for the largest chroma in the gamut; 55 / 2^30 is far below one of 255 steps.
    for _ in range(30):
        chroma = np.where(_in_gamut(_lab_to_linear(lightness, high, hue)), high, 0.5 * (low + high))
        fits = _in_gamut(_lab_to_linear(lightness, chroma, hue))
        low, high = np.where(fits, chroma, low), np.where(fits, high, chroma)
    linear = np.clip(_lab_to_linear(lightness, low, hue), 0.0, 1.0)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.floor(encoded * 255.0 + 0.5).astype(np.uint8)


def _lab_to_linear(lightness: np.ndarray, chroma: np.ndarray, hue: np.ndarray) -> np.ndarray:
    """CIE L*, chroma, hue (radians) under D65 to linear sRGB (..., 3), outside [0, 1] where out of gamut."""
    y = (lightness + 16.0) / 116.0
    f = np.stack([y + chroma * np.cos(hue) / 500.0, y, y - chroma * np.sin(hue) / 200.0], axis=-1)
    xyz = np.where(f > 6 / 29, f**3, 3 * (6 / 29) ** 2 * (f - 4 / 29)) * (0.95047, 1.0, 1.08883)
    to_rgb = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
    return xyz @ to_rgb.T


def _in_gamut(linear: np.ndarray) -> np.ndarray:
    return np.asarray(((linear >= 0.0) & (linear <= 1.0)).all(axis=-1))


def depth_preview(depth: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 of a depth map: near is bright yellow, far dark blue, over the middle 98 % of its inverse depths;
    none is black."""
    valid = np.isfinite(depth) & (depth > 0)
    if not valid.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    inverse = np.where(valid, 1.0 / np.where(valid, depth, 1.0), 0.0)
    low, high = np.percentile(inverse[valid], [1, 99])
    value = np.clip((inverse - low) / max(high - low, 1e-12), 0, 1)
    # Control colours from dark blue over green to yellow, evenly spaced in lightness.
    stops = np.array(
        [[30, 20, 80], [40, 70, 140], [30, 125, 140], [60, 175, 110], [150, 215, 70], [250, 240, 60]], float
    )
    position = value * (len(stops) - 1)
    index = np.minimum(position.astype(int), len(stops) - 2)
    part = (position - index)[..., None]
    color = stops[index] * (1 - part) + stops[index + 1] * part
    return np.where(valid[..., None], np.rint(color), 0).astype(np.uint8)


# Anchors of the colours of a scalar, from low to high.
SCALE = np.array([[48, 40, 120], [40, 120, 200], [60, 190, 120], [235, 210, 60], [215, 50, 40]], dtype=np.float64)


def color_scale(values: np.ndarray, top: float | None = None) -> np.ndarray:
    """(V, 3) uint8 from blue (0) over green to red (`top`, default the 95 % quantile); NaN is grey."""
    values = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(values)
    if top is None:
        top = float(np.quantile(values[finite], 0.95)) if finite.any() else 1.0
    place = np.clip(np.where(finite, values, 0.0) / (top or 1.0), 0.0, 1.0) * (len(SCALE) - 1)
    low = np.minimum(place.astype(np.int64), len(SCALE) - 2)
    share = (place - low)[:, None]
    colors = SCALE[low] * (1 - share) + SCALE[low + 1] * share
    colors[~finite] = 128.0
    return np.round(colors).astype(np.uint8)
