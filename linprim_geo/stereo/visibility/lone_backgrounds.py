"""Background that one view alone looks at, where others have a surface.

Training explains by an environment at infinity what it had no time to find a surface for. What stands at infinity is
there for every photograph that looks that way past the scene: where none of the others agrees, and stereo of several
has a surface, the rays end there. Beside an outline before a true background windows of stereo have a surface, too, so
a hole counts as a whole.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import label

from linprim_geo.geometry.camera import Camera
from linprim_geo.points.view_pairs import nearest_views, visible_pixels
from linprim_geo.stereo.evidence import CONFIRMED_DEPTH

# Each view is compared with so many that are nearest to it; at least so many have to know the surface.
COMPARED, AGREEING = 12, 3
# More than this share of a connected part of the background has to be so: then 0.99 of the depths are right, of a
# garden and a facade, else 0.86 to 0.94 (DECISIONS 97).
MOST = 0.5
# Times the largest distance between cameras: from there they see the same.
FAR = 1e4


def lone_backgrounds(
    cameras: Sequence[Camera], backgrounds: Sequence[np.ndarray], known: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """(H, W) bool of every view: holes in its background whose `known` depths other views know as well, and that none
    of them takes for background.

    Args:
        backgrounds: (H, W) bool of every view.
        known: (H, W) depths of every view, NaN where there is none.
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
