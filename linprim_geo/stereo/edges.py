"""Where photographs have edges."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import label, uniform_filter

from linprim_geo.stereo.noise import LEAST_OF_PLAIN, plainest

# An edge runs through 3 by 3 pixels whose variance is so many times that of the noise; fewer edge pixels than SPECK
# together are noise.
EDGE_VARIANCE, SPECK = 4.0, 9


def edges_of(grey: np.ndarray, noise: float, most: float = np.inf) -> np.ndarray:
    """(H, W) bool: where an edge runs through a pixel or beside it.

    `noise` is the variance that differences of pixels tell. Blur, demosaicing and JPEG make it equal in neighbours,
    whose differences tell less: where the plainest parts vary more, their variance counts, up to the `most` that noise
    may have (`noise.shared_noise`).
    """
    values = grey.astype(np.float64)
    mean = uniform_filter(values, 3, mode="nearest")
    variance = uniform_filter(values * values, 3, mode="nearest") - mean * mean
    edge = variance > EDGE_VARIANCE * min(most, max(noise, plainest(variance, values) / LEAST_OF_PLAIN))
    parts, _ = label(edge, np.ones((3, 3)))
    return edge & (np.bincount(parts.ravel())[parts] >= SPECK)
