"""A cache of decoded photographs, so that a command decodes each of them once."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path

import numpy as np

# Size of the cache in bytes: a thousand photographs of 480x360, ten of 16 megapixels. Of larger captures, the first
# photographs used are kept, the others are decoded again at every use.
MOST_BYTES = 2**29

Pixels = tuple[np.ndarray, np.ndarray | None]


class DecodedPhotos:
    """Pixels of photographs by a key of the caller, up to `limit` bytes in total.

    A photograph whose files have changed is decoded again. Safe to use from several threads. A copy in another
    process starts empty.
    """

    def __init__(self, limit: int = MOST_BYTES):
        self.limit, self.used = limit, 0
        self._kept: dict[Hashable, tuple[tuple, Pixels]] = {}
        self._lock = threading.Lock()

    def __reduce__(self):
        return DecodedPhotos, (self.limit,)

    def get(self, key: Hashable, files: Sequence[Path], decode: Callable[[], Pixels]) -> Pixels:
        """Return the result of `decode`, or a copy of an earlier result if these files have not changed since."""
        state = tuple(_state(file) for file in files)
        with self._lock:
            kept = self._kept.get(key)
        if kept is not None and kept[0] == state and None not in state:
            return _copy(kept[1])
        pixels = decode()
        with self._lock:
            if (old := self._kept.pop(key, None)) is not None:
                self.used -= _bytes(old[1])
            size = _bytes(pixels)
            if self.used + size <= self.limit:
                self._kept[key] = state, _copy(pixels)
                self.used += size
        return pixels

    def clear(self) -> None:
        """Remove all photographs."""
        with self._lock:
            self._kept.clear()
            self.used = 0


def _copy(pixels: Pixels) -> Pixels:
    rgb, alpha = pixels
    return rgb.copy(), None if alpha is None else alpha.copy()


def _bytes(pixels: Pixels) -> int:
    return sum(array.nbytes for array in pixels if array is not None)


def _state(file: Path) -> tuple[int, int] | None:
    """Return a state of the file that changes when it is written; None if it does not exist."""
    try:
        found = file.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size
