"""Colour maps for errors and depths."""

from __future__ import annotations

import numpy as np


def error_colors(share: np.ndarray) -> np.ndarray:
    """Return colours for values in [0, 1] (clamped), (..., 3) uint8 sRGB: matplotlib's viridis, from dark violet
    through green to light yellow.

    Lightness increases in equal steps, so the order is also visible in grey and to the colour-blind.
    """
    from matplotlib import colormaps  # takes a quarter of a second, so imported only here

    return colormaps["viridis"](np.asarray(share, np.float64), bytes=True)[..., :3]


def depth_preview(depth: np.ndarray) -> np.ndarray:
    """Return (H, W, 3) uint8 of a depth map: near is bright yellow, far dark violet, over the middle 98 % of its
    inverse depths; pixels without depth are black."""
    valid = np.isfinite(depth) & (depth > 0)
    if not valid.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    inverse = np.where(valid, 1.0 / np.where(valid, depth, 1.0), 0.0)
    low, high = np.percentile(inverse[valid], [1, 99])
    colors = error_colors((inverse - low) / max(high - low, 1e-12))
    return np.where(valid[..., None], colors, 0).astype(np.uint8)
