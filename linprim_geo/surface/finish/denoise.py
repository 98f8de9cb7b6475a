"""Smooths a surface within its predicted error, where the photographs do not contradict it.

The photographs fix the position of a vertex only up to its predicted error; deviations smaller than that are noise and
show as wrinkles in the shading. Face normals are averaged within flat parts, vertices follow the normals by at most
their predicted error, and the result is made as smooth as that bound allows (`fairing`). Vertices whose predicted error
would grow, on thin and strongly curved parts, stay where they were.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from linprim_geo.capture.types import View
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.kernels import surface_ops
from linprim_geo.surface.finish.fairing import faired
from linprim_geo.surface.finish.photo_consistency import neighbour_average, predicted_error
from linprim_geo.surface.normals import vertex_normals

# Length of the difference of two unit normals from which on faces are not averaged with each other: 41 degrees, so that
# 45 degree chamfers stay sharp.
CONTRAST = 0.7
# Rounds of averaging normals, and of moving vertices. Normals spread over at most 30 rings of faces.
NORMAL_ROUNDS, VERTEX_ROUNDS = 30, 20
# Rings of neighbours over which predicted errors are averaged before they are compared.
RINGS = 2


def denoised(mesh: Mesh, views: Sequence[View], gains: np.ndarray | None = None) -> Mesh:
    """Return the mesh with smoothed vertices, new normals, and the predicted error of each vertex as `quality`, in the
    mesh's unit.

    Faces stay as they are. Where no photograph predicts an error, only the (NaN) `quality` is set. Memory: some 600
    bytes per vertex. The result is identical to the last bit for any number of threads.

    Args:
        views: with photographs, that see the surface.
        gains: see `photo_consistency.best_agreement`.
    """
    cameras = [view.camera for view in views]

    def error_of(mesh: Mesh) -> np.ndarray:
        return predicted_error(mesh, cameras, (view.load() for view in views), gains)

    error = error_of(mesh)
    if not np.isfinite(error).any():
        return replace(mesh, quality=error)
    smooth = faired(replace(mesh, vertices=filtered(mesh, error), quality=error))
    error_then = error_of(smooth)
    average = neighbour_average(mesh)
    means, means_then = error, error_then
    for _ in range(RINGS):
        means, means_then = average @ means, average @ means_then
    share = (means_then <= means).astype(float)
    for _ in range(RINGS):  # blend between smoothed and unchanged vertices without steps
        share = average @ share
    mesh = replace(
        mesh,
        vertices=mesh.vertices + share[:, None] * (smooth.vertices - mesh.vertices),
        quality=((1 - share) * error + share * error_then).astype(np.float32),
    )
    return replace(mesh, normals=vertex_normals(mesh))


def filtered(mesh: Mesh, bound: np.ndarray) -> np.ndarray:
    """Return the (V, 3) float64 vertices after edge-preserving smoothing of the face normals; each vertex moves at most
    `bound` (V,)."""
    vertices = np.array(mesh.vertices, np.float64, order="C")
    corners, bound = np.ascontiguousarray(mesh.faces, np.int64), np.ascontiguousarray(bound, np.float64)
    surface_ops.filter_normals(corners, bound, CONTRAST, NORMAL_ROUNDS, VERTEX_ROUNDS, vertices)
    return vertices
