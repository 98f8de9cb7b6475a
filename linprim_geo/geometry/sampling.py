"""Sample images at arbitrary positions: bilinear and nearest. Pixel centres are at +0.5."""

from __future__ import annotations

import numpy as np


def sample_bilinear(image: np.ndarray, pixels: np.ndarray, *, repeat: bool = False) -> np.ndarray:
    """Return (..., C) values of the (h, w, C) `image` at (..., 2) positions, with single-precision weights.

    Beyond the outermost pixel centres, the border values are repeated, or the image wraps around with `repeat`.
    """
    height, width = image.shape[:2]
    x, y = pixels[..., 0] - 0.5, pixels[..., 1] - 0.5
    if not repeat:
        x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    u, v = (x - left)[..., None].astype(np.float32), (y - top)[..., None].astype(np.float32)
    if repeat:
        left, top = left % width, top % height
        right, bottom = (left + 1) % width, (top + 1) % height
    else:
        right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    flat = image.reshape(height * width, -1)
    upper = flat[top * width + left] * (1 - u) + flat[top * width + right] * u
    lower = flat[bottom * width + left] * (1 - u) + flat[bottom * width + right] * u
    return upper * (1 - v) + lower * v


def sample_nearest(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return the (H, W) values of the (h, w) `image` at the pixels that contain the (H, W, 2) positions, clamped to the
    image."""
    height, width = image.shape
    column = np.clip(np.floor(pixels[..., 0]).astype(np.int64), 0, width - 1)
    row = np.clip(np.floor(pixels[..., 1]).astype(np.int64), 0, height - 1)
    return image[row, column]
