"""Detect whether photographs show a plain sky.

The brightness of a plain region varies gradually, on walls as well as on a sky with clouds and haze. How this shading
shifts between views tells its depth (`shading.py`): that of a sky is explained by a plane at infinity, and by no nearer
plane as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from linprim_geo.stereo.depth_maps import SURE, DepthMap
from linprim_geo.stereo.planes.constrained_planes import EQUAL_RATIO
from linprim_geo.stereo.planes.plain_regions import common_planes, in_world, regions_of_views
from linprim_geo.stereo.planes.point_planes import confirmed_points, planes_of_points
from linprim_geo.stereo.planes.right_angles import frame_of
from linprim_geo.stereo.planes.shaded_planes import (
    FAR,
    FIRST_BOXES,
    LEAST_VIEWS,
    MOST_RESIDUAL_SHARE,
    ShadedPlanes,
)
from linprim_geo.stereo.planes.shading import (
    Fit,
    ShadedRegion,
    Shading,
    evaluate,
    fit_plane,
    shaded_regions,
    starting_planes,
)

# Planes are started at the depths around a region, and at so many times the median depth of the photograph.
STARTS = (1.0, 2.0, 4.0)


def shows_sky(maps: Sequence[DepthMap]) -> list[bool]:
    """Return for every view whether it shows a plain region whose shading a background carries better than any plane:
    its own, and those that several regions share.

    No walls and no reflecting floors are mistaken for a sky (DECISIONS 89); a sky without clouds is not detected.
    """
    cameras = [found.camera for found in maps]
    sure = [np.where(found.is_confirmed(SURE), found.depth, np.float32(np.nan)) for found in maps]
    regions = [region for own in regions_of_views(maps, sure) for region in own]
    nothing = [np.zeros_like(depth) for depth in sure]
    by_points, weight = planes_of_points(*confirmed_points(maps, sure))
    by_edges = common_planes(cameras, regions)
    shaded = ShadedPlanes(maps, sure, nothing, by_points, by_edges, frame_of(by_points[:, :3], weight))
    planes, result = shaded.planes[shaded.by_points :], []
    for view, (shading, known) in enumerate(zip(shaded.shadings, shaded.depths, strict=True)):
        own = shaded_regions(view, shading, np.isfinite(known))
        result.append(any(_is_sky(region, known, planes, shaded.shadings) for region in own))
    return result


def _is_sky(region: ShadedRegion, known: np.ndarray, planes: np.ndarray, shadings: Sequence[Shading]) -> bool:
    """Return whether a region of a view is sky, given the view's sure depths `known` (H, W), NaN elsewhere, and lies on
    none of the (K, 4) planes."""
    shading = shadings[region.view]
    if not np.isfinite(known).any():
        return False
    depth = float(np.nanmedian(known))
    others = tuple(view for view in range(len(shadings)) if view != region.view)
    region = replace(region, depth=depth, others=others).some(FIRST_BOXES)

    def in_views(fit: Fit | None) -> Fit | None:
        return fit if fit is not None and fit.views >= LEAST_VIEWS else None

    far = in_views(evaluate(in_world(shading.camera, np.array([0, 0, 1 / (FAR * depth)])), [region], shadings))
    if far is None or far.left_share > MOST_RESIDUAL_SHARE:
        return False
    starts = starting_planes(region, known, np.zeros_like(known))
    starts += [np.array([0, 0, 1 / (times * depth)]) for times in STARTS]
    fits = [in_views(fit_plane(in_world(shading.camera, start), [region], shadings)) for start in starts]
    fits += [evaluate(plane, [region], shadings) for plane in planes]
    return all(fit.left_share > EQUAL_RATIO * far.left_share for fit in fits if fit is not None)
