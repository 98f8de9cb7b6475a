"""The photographs of a synthetic capture as files: sensor noise, rounding, PNG and JPEG."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def sensor_noise(values: np.ndarray, strength: float, seed: tuple[int, ...]) -> np.ndarray:
    """Return colours (H, W, 3) float32 with noise, independent per pixel and channel, not clipped to [0, 1].

    Its variance at colour v is (strength / 255)^2 (1/2 + v): read noise plus shot noise, which is proportional to the
    signal. Both are equal at v = 1/2, where the standard deviation is `strength` / 255.
    """
    if strength == 0.0:
        return values
    normal = np.random.default_rng(seed).standard_normal(values.shape, dtype=np.float32)
    deviation = np.float32(strength / 255.0) * np.sqrt(np.float32(0.5) + np.clip(values, 0.0, 1.0))
    return values + deviation * normal


def to_bytes(values: np.ndarray) -> np.ndarray:
    """Return values clipped to [0, 1] as the nearest uint8."""
    return (np.clip(values, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def photo_name(split: str, number: int, jpeg: int) -> str:
    """Return the path of a photograph in the folder of the capture."""
    return f"{split}/{number:03d}.{'jpg' if jpeg else 'png'}"


def save_png(path: Path, pixels: np.ndarray) -> None:
    """Write (H, W), (H, W, 3) or (H, W, 4) pixels as PNG."""
    from PIL import Image

    # Level 3 takes a third of the time of Pillow's default of 6, for files a few per cent larger.
    Image.fromarray(np.ascontiguousarray(pixels)).save(path, compress_level=3)


def save_photo(path: Path, pixels: np.ndarray, jpeg: int) -> None:
    """Write (H, W, 3) uint8 as JPEG of quality `jpeg` (chroma at half resolution), or any pixels as PNG if it is 0."""
    from PIL import Image

    if jpeg:
        Image.fromarray(np.ascontiguousarray(pixels)).save(path, quality=jpeg)
    else:
        save_png(path, pixels)
