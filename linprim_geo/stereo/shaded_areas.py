"""Where in its view a region's shading is carried by a plane, and what points along the region's edges say against it.

Faint shading is carried as well by a plane that is turned by many degrees, or by one that is some per cent farther;
points along edges tell such planes apart. These err where an occluder's edges are taken for the region's own, which the
shading that their plane leaves gives away."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from linprim_geo.stereo.enclosing_planes import SURE_SHARE
from linprim_geo.stereo.held_planes import AS_WELL, MOST_BOXES
from linprim_geo.stereo.plain_regions import TOLERANCE, in_camera
from linprim_geo.stereo.shading import ShadedRegion, Shading, evaluate


@dataclass(frozen=True)
class ShadedArea:
    """The `number` of the plane that carries the shading of a region, in the pixels `where` (H, W) bool of its view's
    shading."""

    region: ShadedRegion
    number: int
    where: np.ndarray


def told_by_edges(
    area: ShadedArea, along_edges: np.ndarray, planes: np.ndarray, shadings: Sequence[Shading]
) -> ShadedArea:
    """The area, on the plane of (K, 4) ones of the world on which the most of it lies by points `along_edges` ((H, W)
    numbers of a view, -1 elsewhere), if that one is elsewhere by more than TOLERANCE and carries its shading as well.
    """
    shading, few = shadings[area.region.view], [area.region.some(MOST_BOXES)]
    numbers = shading.small(along_edges)[area.where]
    pixels = np.bincount(numbers[numbers >= 0], minlength=len(planes))
    told = int(np.argmax(pixels))
    if told == area.number or pixels[told] < SURE_SHARE * len(numbers):
        return area
    by_shading, by_edges = in_camera(shading.camera, planes[[area.number, told]]) @ few[0].rays.T
    if (by_edges <= 0).any() or np.median(np.abs(by_edges / by_shading - 1)) < TOLERANCE:
        return area
    own, other = (evaluate(planes[number], few, shadings) for number in (area.number, told))
    carries = own is not None and other is not None and other.left_share <= AS_WELL * own.left_share
    return replace(area, number=told) if carries else area
