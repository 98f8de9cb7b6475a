"""Smooths a surface where photographs have nothing against it.

Photographs tell where a vertex is up to its predicted error; what the surface does within it is noise, and wrinkles in
the shading. Normals of faces are averaged within flat parts, vertices follow them by no more than their predicted
error, and then bend as little as that allows (`fairing`). They stay where they were where photographs agree less
afterwards: on thin and strongly curved parts.
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

# Length of the difference of two unit normals: faces with 41 degrees or more between them are on two sides of an edge,
# so that 45 degree chamfers stay.
CONTRAST = 0.7
# Rounds of averaging, and of moving vertices: as far as 30 rings of faces.
NORMAL_ROUNDS, VERTEX_ROUNDS = 30, 20
# Rings of neighbours over which predicted errors are compared.
RINGS = 2


def denoised(mesh: Mesh, views: Sequence[View], gains: np.ndarray | None = None) -> Mesh:
    """The mesh with vertices moved, and the predicted error of each as `quality`, in the mesh's unit.

    Faces stay as they are, normals are made anew. Memory: some 600 bytes per vertex. The same to the last bit for any
    number of threads.

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
    for _ in range(RINGS):  # no steps between what is taken and what is not
        share = average @ share
    mesh = replace(
        mesh,
        vertices=mesh.vertices + share[:, None] * (smooth.vertices - mesh.vertices),
        quality=((1 - share) * error + share * error_then).astype(np.float32),
    )
    return replace(mesh, normals=vertex_normals(mesh))


def filtered(mesh: Mesh, bound: np.ndarray) -> np.ndarray:
    """(V, 3) float64 vertices of a mesh whose normals are smoothed but for edges, each at most `bound` (V,) away."""
    vertices = np.array(mesh.vertices, np.float64, order="C")
    corners, bound = np.ascontiguousarray(mesh.faces, np.int64), np.ascontiguousarray(bound, np.float64)
    surface_ops.filter_normals(corners, bound, CONTRAST, NORMAL_ROUNDS, VERTEX_ROUNDS, vertices)
    return vertices
