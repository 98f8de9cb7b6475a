"""Find parts of photographs that are far away: other photographs show them in the same direction.

Training fills the sky beside objects with fog, as few photographs look past them, and windows of stereo extend the
objects' outlines. A connected part between edges is assumed to be one object. All of it is far if stereo knows nothing
of it, training sees background in most of it, and other photographs show the same grey where they look in that
direction past everything. The side of a table, which an environment map can explain as well, is not shown there by any
of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import label

from linprim_geo.points.view_pairs import visible_pixels
from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.planes.plain_regions import HALF_EDGE, grown_alike, rays_of, to_world
from linprim_geo.stereo.planes.seen_through import FreeSpaceTest
from linprim_geo.stereo.visibility.lone_backgrounds import FAR

# The largest share of a far part whose depth may be known, beside the outlines of objects.
KNOWN_SHARE = 0.1
# More than this share of a part's unknown pixels has to be background, and other photographs have to show more than
# this share of its sampled pixels.
MOST = 0.5
# The most pixels of a part that are compared with other photographs.
LOOKED_AT = 100


def far_parts(
    maps: Sequence[DepthMap],
    backgrounds: Sequence[np.ndarray],
    known: Sequence[np.ndarray],
    rendered: Sequence[np.ndarray],
    far: Sequence[np.ndarray],
) -> list[np.ndarray]:
    """Return (H, W) bool of every view: pixels that are `far`, parts between edges that are, and edge pixels beside
    both of the same grey. Pixels are excluded if more views know a surface at their rendered depth than look past it,
    as edges have gaps.

    Args:
        backgrounds: (H, W) bool of every view, where training has rendered nothing.
        known: (H, W) depths of every view, NaN where unknown.
        rendered: (H, W) depths of every view, 0 where none.
        far: (H, W) bool of every view, regions already known to be far.
    """
    if not any(some.any() for some in (*backgrounds, *far)):
        return list(far)
    cameras = [found.camera for found in maps]
    free = [background & np.isnan(depth) for background, depth in zip(backgrounds, known, strict=True)]
    distance = FAR * float(np.ptp([camera.center for camera in cameras], axis=0).max())
    result = []
    for view, (found, depth, told) in enumerate(zip(maps, known, far, strict=True)):
        edge = found.edges
        part, parts = label(~edge)
        size, of_unknown, of_free = (
            np.bincount(part[where], minlength=parts + 1) for where in (~edge, np.isnan(depth), free[view])
        )
        asked = (of_unknown >= (1 - KNOWN_SHARE) * size) & (of_free > MOST * of_unknown)
        row, column = _some_of_each(np.where(asked[part] & ~edge, part, 0))
        shown, number = _shown_by_others(maps, free, view, row, column, distance), part[row, column]
        is_far = np.bincount(number[shown], minlength=parts + 1) > MOST * np.bincount(number, minlength=parts + 1)
        result.append(grown_alike(told | (is_far[part] & ~edge), found.grey, edge))
    seen = (np.where(np.isnan(depth) & past, distance, depth) for depth, past in zip(known, result, strict=True))
    looking = FreeSpaceTest(cameras, seen)
    for camera, depth, told, past in zip(cameras, rendered, far, result, strict=True):
        row, column = np.nonzero(past & ~told & (depth > 0))
        is_surface = looking.know(to_world(camera, rays_of(camera, row, column) * depth[row, column, None]))
        past[row[is_surface], column[is_surface]] = False
    return result


def _some_of_each(part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of at most LOOKED_AT pixels, evenly spaced, of each part in (H, W) numbers other than
    0."""
    row, column = np.nonzero(part)
    order = np.argsort(part[row, column], kind="stable")
    row, column = row[order], column[order]
    _, first, size = np.unique(part[row, column], return_index=True, return_counts=True)
    rank = np.arange(len(row)) - np.repeat(first, size)
    some = rank % np.repeat(-(-size // LOOKED_AT), size) == 0
    return row[some], column[some]


def _shown_by_others(
    maps: Sequence[DepthMap],
    free: Sequence[np.ndarray],
    view: int,
    row: np.ndarray,
    column: np.ndarray,
    distance: float,
) -> np.ndarray:
    """Return (P,) bool: which pixels of a view, placed at `distance`, another photograph shows where it is `free` (H,
    W), in similar grey."""
    camera, grey = maps[view].camera, maps[view].grey[row, column].astype(int)
    points, shown = camera.center + camera.world_rays()[row, column] * distance, np.zeros(len(row), bool)
    for other, found in enumerate(maps):
        if other != view:
            inside, (x, y), _ = (np.asarray(each).T for each in visible_pixels(found.camera, points))
            shown[inside] |= free[other][y, x] & (np.abs(found.grey[y, x] - grey[inside]) < 2 * HALF_EDGE)
    return shown
