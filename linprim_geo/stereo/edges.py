"""Detect edges of photographs: in grey, and in colour, where two surfaces are equally bright."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import label, uniform_filter

from linprim_geo.stereo.noise import LEAST_OF_PLAIN, noise_of, plainest

# Weights of red, green and blue in grey (ITU-R BT.601).
GREY = (0.299, 0.587, 0.114)
# A pixel is on an edge if the variance of the 3 by 3 pixels around exceeds that of the noise by this factor. Connected
# components of fewer than SPECK pixels are noise.
EDGE_VARIANCE, SPECK = 4.0, 9


def edges_of(grey: np.ndarray, noise: float, most: float = np.inf) -> np.ndarray:
    """Return (H, W) bool: pixels on or beside an edge.

    `noise` is the variance estimated from differences of pixels. Blur, demosaicing and JPEG correlate the noise of
    neighbours, so that differences underestimate it. Where the plainest parts vary more, their variance counts, up to
    the upper bound `most` from other views (`noise.shared_noise`).
    """
    values = grey.astype(np.float64)
    mean = uniform_filter(values, 3, mode="nearest")
    variance = uniform_filter(values * values, 3, mode="nearest") - mean * mean
    edge = variance > EDGE_VARIANCE * min(most, max(noise, plainest(variance, values) / LEAST_OF_PLAIN))
    parts, _ = label(edge, np.ones((3, 3)))
    return edge & (np.bincount(parts.ravel())[parts] >= SPECK)


def colours_of(rgb: np.ndarray) -> np.ndarray:
    """Return (2, H // 2, W // 2) float32: the colour differences (R - B) / 2 and G - (R + B) / 2 of (H, W, 3) pixels,
    in means of 2 by 2 pixels, as JPEG stores them."""
    height, width = (size // 2 for size in rgb.shape[:2])
    means = rgb[: 2 * height, : 2 * width].reshape(height, 2, width, 2, 3).mean((1, 3), dtype=np.float32)
    red, green, blue = np.moveaxis(means, 2, 0)
    return np.stack([(red - blue) / 2, green - (red + blue) / 2])


def rgb_of(grey: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """Return (H // 2, W // 2, 3) colours of means of 2 by 2 pixels, given their grey by GREY and colour differences by
    `colours_of`."""
    apart, green = colours
    middle = grey - (GREY[0] - GREY[2]) * apart - GREY[1] * green  # (R + B) / 2
    return np.stack([middle + apart, middle + green, middle - apart], axis=-1)


def colour_edges(colours: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return (H, W) bool for a photograph of this shape: where either of its colour differences (`colours_of`) has an
    edge."""
    result = np.zeros(shape, bool)
    height, width = colours.shape[1:]
    for colour in colours:
        # Shifted to 128, as `edges_of` does not estimate noise from nearly black or white values.
        edge = edges_of(colour + 128, noise_of(colour))
        result[: 2 * height, : 2 * width] |= edge.repeat(2, 0).repeat(2, 1)
    return result
