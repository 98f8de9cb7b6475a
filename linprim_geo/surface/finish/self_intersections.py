"""Where a surface goes through itself."""

from __future__ import annotations

import numpy as np

from linprim_geo.base.sorting import distinct
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.kernels import surface_ops


def edges_of(faces: np.ndarray) -> np.ndarray:
    """(E, 2) int64 vertices of the edges of (F, 3) faces, each once, the lower number first, in order."""
    start, end = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    count = int(faces.max(initial=0)) + 1
    return np.stack(np.divmod(distinct(np.minimum(start, end) * count + np.maximum(start, end)), count), axis=1)


def crossings(mesh: Mesh, edges: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Faces that an edge crosses with which they share no vertex: (N,) numbers of faces and (N, 2) ends of edges, by
    edge and then by face.

    Faces that only touch or lie in one plane, up to the rounding of float64, do not count; those without area are
    crossed by nothing.
    Memory: some 150 bytes per face.

    Args:
        edges: (E, 2) of `edges_of` that are looked along; None for all.
    """
    corners, vertices = np.ascontiguousarray(mesh.faces, np.int64), np.ascontiguousarray(mesh.vertices, np.float64)
    ends = edges_of(corners) if edges is None else edges
    face, edge = surface_ops.crossings(corners, vertices, np.ascontiguousarray(ends))
    return face, ends[edge]
