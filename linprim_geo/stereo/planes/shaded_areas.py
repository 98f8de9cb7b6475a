"""The pixels of a region whose shading a plane carries, and which plane the points along the region's edges favour.

Faint shading is explained as well by a plane turned by many degrees, or some per cent farther. Points along edges tell
such planes apart, but err if the edges of an occluder are taken for the region's own. The larger residual of shading
then shows that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from linprim_geo.stereo.planes.constrained_planes import EQUAL_RATIO, MOST_BOXES, SUPPORTED_RATIO
from linprim_geo.stereo.planes.enclosing_planes import SURE_SHARE
from linprim_geo.stereo.planes.plain_regions import TOLERANCE, in_camera
from linprim_geo.stereo.planes.shading import ShadedRegion, Shading, evaluate


@dataclass(frozen=True, eq=False)
class ShadedArea:
    """The pixels `where` (H, W) bool, in the small photograph of a view's shading, in which plane `number` carries a
    region's shading."""

    region: ShadedRegion
    number: int
    where: np.ndarray


def best_first(carriers: dict[int, np.ndarray], carried: np.ndarray) -> list[int]:
    """Return the numbers of those `carriers` that carry about as many boxes of a region as any does, first the one with
    the highest `carried` (K,). `carriers` has (N,) bool of each plane: the boxes that it carries."""
    most = max(np.count_nonzero(boxes) for boxes in carriers.values())
    as_well = [k for k, boxes in carriers.items() if EQUAL_RATIO * np.count_nonzero(boxes) >= most]
    return sorted(as_well, key=lambda k: carried[k], reverse=True)


def preferred_by_edges(
    area: ShadedArea, along_edges: np.ndarray, planes: np.ndarray, shadings: Sequence[Shading]
) -> ShadedArea:
    """Return the area on the plane that points along edges favour, if it carries the region's shading as well as the
    area's own plane. Return the area unchanged if not, or if both planes are the same within TOLERANCE.

    Args:
        along_edges: (H, W) numbers of the planes on which pixels of the view lie by points along edges, -1 elsewhere.
        planes: (K, 4) of the world, n . x = d.
    """
    shading, few = shadings[area.region.view], [area.region.some(MOST_BOXES)]
    numbers = shading.small(along_edges)[area.where]
    pixels = np.bincount(numbers[numbers >= 0], minlength=len(planes))
    other_number = int(np.argmax(pixels))
    if other_number == area.number or pixels[other_number] < SURE_SHARE * len(numbers):
        return area
    by_shading, by_edges = in_camera(shading.camera, planes[[area.number, other_number]]) @ few[0].rays.T
    if (by_edges <= 0).any() or np.median(np.abs(by_edges / by_shading - 1)) < TOLERANCE:
        return area
    own, other = (evaluate(planes[number], few, shadings) for number in (area.number, other_number))
    carries = own is not None and other is not None and other.left_share <= SUPPORTED_RATIO * own.left_share
    return replace(area, number=other_number) if carries else area
