"""Where in its view a region's shading is carried by a plane, and what points along the region's edges say against it.

Faint shading is carried as well by a plane that is turned by many degrees, or by one that is some per cent farther;
points along edges tell such planes apart. These err where an occluder's edges are taken for the region's own, which the
shading that their plane leaves gives away."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from linprim_geo.stereo.planes.enclosing_planes import SURE_SHARE
from linprim_geo.stereo.planes.held_planes import AS_WELL, HARDLY_MORE, MOST_BOXES
from linprim_geo.stereo.planes.plain_regions import TOLERANCE, in_camera
from linprim_geo.stereo.planes.shading import ShadedRegion, Shading, evaluate


@dataclass(frozen=True, eq=False)
class ShadedArea:
    """The `number` of the plane that carries the shading of a region, in the pixels `where` (H, W) bool of its view's
    shading."""

    region: ShadedRegion
    number: int
    where: np.ndarray


def best_first(carriers: dict[int, np.ndarray], carried: np.ndarray) -> list[int]:
    """The numbers of those `carriers` that carry about as many boxes of a region as any does, by (N,) bool which of
    these: first the one with most of `carried` (K,)."""
    most = max(np.count_nonzero(boxes) for boxes in carriers.values())
    as_well = [k for k, boxes in carriers.items() if HARDLY_MORE * np.count_nonzero(boxes) >= most]
    return sorted(as_well, key=lambda k: carried[k], reverse=True)


def told_by_edges(
    area: ShadedArea, along_edges: np.ndarray, planes: np.ndarray, shadings: Sequence[Shading]
) -> ShadedArea:
    """The area on the plane that points along edges tell, if it carries the region's shading as well as the area's own;
    the area itself if it does not, or if both are the same within TOLERANCE.

    Args:
        along_edges: (H, W) numbers of the planes on which pixels of the view lie by points along edges, -1 elsewhere.
        planes: (K, 4) of the world, n . x = d.
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
