"""Conversion between sRGB values and linear intensity."""

from __future__ import annotations

import numpy as np


def to_linear(value: np.ndarray) -> np.ndarray:
    """Convert sRGB to linear intensity (IEC 61966-2-1), below 0 and above 1 by the same formulas."""
    value = np.asarray(value)
    return np.where(value <= 0.04045, value / 12.92, ((np.maximum(value, 0.04045) + 0.055) / 1.055) ** 2.4)


def to_srgb(value: np.ndarray) -> np.ndarray:
    """Convert linear intensity to sRGB, the inverse of `to_linear`."""
    value = np.asarray(value)
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * np.maximum(value, 0.0031308) ** (1 / 2.4) - 0.055)
