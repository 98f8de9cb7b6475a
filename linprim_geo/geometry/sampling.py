"""Samples of images at any place: bilinear and nearest."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    pass


def sample_bilinear(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(H, W, C) float32 values of the (h, w, C) `image` at the (H, W, 2) positions, pixel centres at +0.5,
    clamped."""
    height, width = image.shape[:2]
    x = np.clip(pixels[..., 0] - 0.5, 0, width - 1)
    y = np.clip(pixels[..., 1] - 0.5, 0, height - 1)
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    u, v = (x - left)[..., None].astype(np.float32), (y - top)[..., None].astype(np.float32)
    flat = image.reshape(height * width, -1)
    upper = flat[top * width + left] * (1 - u) + flat[top * width + right] * u
    lower = flat[bottom * width + left] * (1 - u) + flat[bottom * width + right] * u
    return upper * (1 - v) + lower * v


def sample_nearest(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(H, W) values of the (h, w) `image` at the pixels that hold the (H, W, 2) positions, clamped."""
    height, width = image.shape
    column = np.clip(np.floor(pixels[..., 0]).astype(np.int64), 0, width - 1)
    row = np.clip(np.floor(pixels[..., 1]).astype(np.int64), 0, height - 1)
    return image[row, column]


def bilinear(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(P, C) float32 colours, 0 to 255, at (2, P) pixel positions."""
    scale = 1.0 if image.dtype == np.uint8 else 255.0
    height, width = image.shape[:2]
    x = np.clip(pixels[0] - 0.5, 0, width - 1)
    y = np.clip(pixels[1] - 0.5, 0, height - 1)
    j = np.minimum(x.astype(np.int64), max(width - 2, 0))
    i = np.minimum(y.astype(np.int64), max(height - 2, 0))
    x, y = (x - j)[:, None], (y - i)[:, None]
    right, below = np.minimum(j + 1, width - 1), np.minimum(i + 1, height - 1)
    top = image[i, j] * (1 - x) + image[i, right] * x
    bottom = image[below, j] * (1 - x) + image[below, right] * x
    return (scale * (top * (1 - y) + bottom * y)).astype(np.float32)
