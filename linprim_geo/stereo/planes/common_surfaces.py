"""Count which other views know a surface that one view supposes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from linprim_geo.geometry.camera import Camera
from linprim_geo.points.view_pairs import visible_pixels
from linprim_geo.stereo.planes.plain_regions import rays_of, to_world

# Depths are sampled at every STRIDE-th row and column. A view knows a surface if at least LEAST_POINTS of its points
# lie on it: half of the boxes of the smallest region with a plane (`shading.LEAST_BOXES`).
STRIDE, LEAST_POINTS = 4, 30
# A point is on a surface if its depth differs by at most this share, the error of planes.
ON_IT = 0.05


class SurfaceSupport:
    """Sampled points on the surfaces that views know: at `confirmed` depths (H, W) of each camera, NaN where unknown,
    and at `supposed` ones where those are unknown."""

    def __init__(self, cameras: Sequence[Camera], confirmed: Sequence[np.ndarray], supposed: Sequence[np.ndarray]):
        self.cameras = cameras
        points, views, sure = [np.zeros((0, 3))], [np.zeros(0, int)], [np.zeros(0, bool)]
        for view, (camera, own, others) in enumerate(zip(cameras, confirmed, supposed, strict=True)):
            depth = np.where(np.isfinite(own), own, others)
            row, column = (STRIDE * x for x in np.nonzero(np.isfinite(depth[::STRIDE, ::STRIDE])))
            points.append(to_world(camera, rays_of(camera, row, column) * depth[row, column, None]))
            views.append(np.full(len(row), view))
            sure.append(np.isfinite(own[row, column]))
        self.points, self.views, self.sure = (np.concatenate(parts) for parts in (points, views, sure))

    def supporting_views(
        self, view: int, depths: Sequence[np.ndarray], only_confirmed: Sequence[bool]
    ) -> list[np.ndarray]:
        """Return for each of several depths (H, W) of a view, NaN where none, the numbers of the other views with
        enough points on it; only confirmed points where `only_confirmed` is true."""
        if not depths:
            return []
        others = self.views != view
        inside, pixels, along = visible_pixels(self.cameras[view], self.points[others])
        views, sure, (column, row) = self.views[others][inside], self.sure[others][inside], pixels.T
        result = []
        for depth, only_sure in zip(depths, only_confirmed, strict=True):
            on_it = np.abs(along / depth[row, column] - 1) <= ON_IT
            result.append(np.flatnonzero(np.bincount(views[on_it & (sure | (not only_sure))]) >= LEAST_POINTS))
        return result
