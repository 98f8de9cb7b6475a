"""Where in its view a region's shading is carried by a plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from linprim_geo.stereo.shading import ShadedRegion


@dataclass(frozen=True)
class ShadedArea:
    """The `number` of the plane that carries the shading of a region, in the pixels `where` (H, W) bool of its view's
    shading."""

    region: ShadedRegion
    number: int
    where: np.ndarray
