"""Read and write maps in COLMAP's file format of dense reconstruction.

A file is a line of text, `WIDTH&HEIGHT&CHANNELS&`, and little-endian float32 numbers: all rows of the first channel,
then those of the next.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write

# The most characters of a header: three numbers of at most ten digits, and separators.
_LONGEST_HEADER = 3 * 10 + 3


def write_map(path: Path, values: np.ndarray) -> None:
    """Write (H, W) or (H, W, C) numbers."""
    channels = values[..., None] if values.ndim == 2 else values
    height, width, count = channels.shape
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        file.write(f"{width}&{height}&{count}&".encode("ascii"))
        file.write(np.ascontiguousarray(np.moveaxis(channels, 2, 0), "<f4").tobytes())


def read_map(path: Path) -> np.ndarray:
    """Return the (H, W) float32 map of a file with one channel, else (H, W, C).

    Raises:
        LinprimError: the file cannot be read, or is not such a map.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise LinprimError(f"{path}: cannot be read ({error.strerror}), wanted a map of float32 numbers") from error
    words = data[:_LONGEST_HEADER].split(b"&", 3)
    if len(words) < 4 or not all(word.isdigit() for word in words[:3]):
        raise LinprimError(f"{path}: does not begin with WIDTH&HEIGHT&CHANNELS&, wanted a map as COLMAP writes it")
    width, height, count = (int(word) for word in words[:3])
    start = sum(len(word) + 1 for word in words[:3])
    if len(data) - start != 4 * width * height * count:
        raise LinprimError(
            f"{path}: holds {len(data) - start} bytes of numbers, wanted {4 * width * height * count} for "
            f"{width}x{height} pixels with {count} of them"
        )
    values = np.frombuffer(data, "<f4", offset=start).reshape(count, height, width)
    return values[0] if count == 1 else np.ascontiguousarray(np.moveaxis(values, 0, 2))
