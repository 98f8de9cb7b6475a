"""Find background that one view alone has, where other views know a surface.

Training explains by an environment at infinity where it has not yet found a surface. A true background is at infinity
for all photographs that look past the scene in that direction. If none of the others agrees and stereo of several knows
a surface, that surface is taken. Windows of stereo also give surfaces beside an outline in front of a true background,
so that a hole is decided as a whole.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import label

from linprim_geo.geometry.camera import Camera
from linprim_geo.points.view_pairs import nearest_views, visible_pixels
from linprim_geo.stereo.evidence import CONFIRMED_DEPTH

# The number of nearest views with which each view is compared, and the fewest that have to know the surface.
COMPARED, AGREEING = 12, 3
# More than this share of a connected part of the background has to be so. Then 0.99 of the depths of a garden and a
# facade are right, else 0.86 to 0.94 (DECISIONS 97).
MOST = 0.5
# Infinity, as a multiple of the largest distance between cameras.
FAR = 1e4


def lone_backgrounds(
    cameras: Sequence[Camera], backgrounds: Sequence[np.ndarray], known: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return (H, W) bool of every view: holes in its background whose `known` depths other views know as well, and
    which none of them takes for background.

    Args:
        backgrounds: (H, W) bool of every view.
        known: (H, W) depths of every view, NaN where unknown.
    """
    centers = np.array([camera.center for camera in cameras])
    far = FAR * float(np.ptp(centers, axis=0).max())
    result = []
    for camera, background, depth, others in zip(
        cameras, backgrounds, known, nearest_views(cameras, COMPARED), strict=True
    ):
        lone = background & np.isfinite(depth)
        rays = camera.world_rays()[lone]
        surface, infinity = camera.center + rays * depth[lone][:, None], camera.center + rays * far
        knowing, sharing = np.zeros(len(rays), int), np.zeros(len(rays), bool)
        for other in others:
            inside, pixels, along = visible_pixels(cameras[other], surface)
            knowing[inside] += np.abs(known[other][pixels[:, 1], pixels[:, 0]] / along - 1) < CONFIRMED_DEPTH
            inside, pixels, _ = visible_pixels(cameras[other], infinity)
            sharing[inside] |= backgrounds[other][pixels[:, 1], pixels[:, 0]]
        lone[lone] = (knowing >= AGREEING) & ~sharing
        part, parts = label(background)
        of_part = np.bincount(part[lone], minlength=parts + 1) > MOST * np.bincount(part.ravel(), minlength=parts + 1)
        result.append(lone & of_part[part])
    return result
