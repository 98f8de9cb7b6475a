"""Finds the self-intersections of a mesh."""

from __future__ import annotations

import numpy as np

from linprim_geo.base.sorting import distinct
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.kernels import surface_ops


def edges_of(faces: np.ndarray) -> np.ndarray:
    """Return the (E, 2) int64 vertices of the edges of (F, 3) faces: each edge once, lower vertex first, sorted."""
    start, end = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    count = int(faces.max(initial=0)) + 1
    return np.stack(np.divmod(distinct(np.minimum(start, end) * count + np.maximum(start, end)), count), axis=1)


def crossings(mesh: Mesh, edges: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Find faces that an edge pierces with which they share no vertex. Return (N,) face numbers and (N, 2) ends of the
    edges, sorted by edge and then by face.

    Faces that only touch or are coplanar, up to the rounding of float64, do not count, and faces without area are never
    pierced. Memory: some 150 bytes per face.

    Args:
        edges: (E, 2) of `edges_of` that are tested; None for all.
    """
    corners, vertices = np.ascontiguousarray(mesh.faces, np.int64), np.ascontiguousarray(mesh.vertices, np.float64)
    ends = edges_of(corners) if edges is None else edges
    face, edge = surface_ops.crossings(corners, vertices, np.ascontiguousarray(ends))
    return face, ends[edge]
