"""Predicts the error of a surface that is fused from depth maps, by how well these agree with each other at its
vertices."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from linprim_geo.geometry.mesh import Mesh
from linprim_geo.points.initial_points import in_image
from linprim_geo.surface.fusion.stereo_frames import SUPPORTING_VIEWS
from linprim_geo.surface.fusion.tsdf_field import DepthFrame
from linprim_geo.surface.normals import vertex_normals

FINEST = 1 / 10
"""Least error of a depth, as a share of a pixel's footprint: the windows of all views see the same texture, so their
errors are correlated. Chosen by the true errors of eleven captures (DECISIONS 91)."""


def largest_error(reach: float) -> float:
    """Return the root mean square distance of a surface that may lie anywhere within `reach`."""
    return reach / np.sqrt(3)


def error_by_depths(mesh: Mesh, frames: Sequence[DepthFrame], reach: float) -> np.ndarray:
    """Predict the (V,) float32 distance of each vertex from the true surface, in the mesh's unit.

    It is the root mean square distance of the depths that the vertex was fused from, combined with FINEST pixels of the
    nearest view. It is not divided by the number of views, as their errors are correlated. Where the depths weigh less
    than SUPPORTING_VIEWS confirmed ones it is `largest_error`, which is also the upper limit elsewhere. Accuracy:
    `python -m linprim_geo.eval.studies.surfaces` prints its rank correlation with the exact error, and the ratio of
    their means.

    Args:
        frames: with the `confidence` by which depths were fused, 1 for a confirmed depth.
        reach: largest distance from the surface at which depths were fused into it.
    """
    weight, spread, pixel = _spread(mesh, frames, reach)
    largest = largest_error(reach)
    error = np.fmin(np.hypot(spread, FINEST * pixel), largest)
    return np.where(weight >= SUPPORTING_VIEWS, error, largest).astype(np.float32)


def error_of_nearest(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Return for each of (P, 3) points the `quality` of the nearest vertex, or the distance to that vertex if it
    exceeds all predicted errors: such a point lies in a hole that was closed."""
    from scipy.spatial import cKDTree

    assert mesh.quality is not None
    distance, row = cKDTree(mesh.vertices).query(points, workers=-1)
    return np.where(distance > mesh.quality.max(), distance, mesh.quality[row]).astype(np.float32)


def _spread(mesh: Mesh, frames: Sequence[DepthFrame], reach: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Measure how depths scatter around each vertex along its normal.

    Returns: (V,) weight of the depths at most `reach` from a vertex; (V,) their root mean square distance, NaN where
        there are none; (V,) the footprint of a pixel of the nearest view there.
    """
    points = mesh.vertices.astype(np.float64)
    normals = (vertex_normals(mesh) if mesh.normals is None else mesh.normals).astype(np.float64)
    weight, square, pixel = np.zeros(len(points)), np.zeros(len(points)), np.full(len(points), np.inf)
    for frame in frames:
        camera = frame.camera
        inside, row, column = in_image(camera, points)
        rows = np.flatnonzero(inside)
        row, column, own, normal = row[rows], column[rows], points[rows], normals[rows]
        depth = frame.depth[row, column].astype(np.float64)
        ray = camera.world_rays()[row, column]
        # Distance to the tangent plane of the vertex, as the pixel's own ray passes beside the vertex.
        off = ((camera.center + depth[:, None] * ray - own) * normal).sum(1)
        near = (depth > 0) & ((ray * normal).sum(1) < 0) & (np.abs(off) <= reach)
        if frame.clamped is not None:
            near &= ~frame.clamped[row, column]
        rows, off, depth = rows[near], off[near], depth[near]
        assert frame.confidence is not None
        counts = frame.confidence[row[near], column[near]].astype(np.float64)
        weight[rows] += counts
        square[rows] += counts * off**2
        pixel[rows] = np.minimum(pixel[rows], depth / max(camera.fx, camera.fy))
    with np.errstate(invalid="ignore"):  # 0 / 0
        return weight, np.sqrt(square / weight), pixel
