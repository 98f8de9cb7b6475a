"""Vertex normals of a mesh, and faces that are folded over."""

from __future__ import annotations

import numpy as np

from linprim_geo.geometry.mesh import Mesh
from linprim_geo.kernels import surface_ops


def vertex_normals(mesh: Mesh) -> np.ndarray:
    """Return (V, 3) float64 unit normals: face normals averaged with the angle of the face at the vertex as weight.

    The weight makes the normal independent of how flat parts are triangulated. Vertices of no face get zero.

    Source: Thuermer and Wuethrich, Computing vertex normals from polygonal facets, 1998.
    """
    return _normals(mesh)[0]


def folded(mesh: Mesh) -> np.ndarray:
    """Return (F,) bool: faces whose normals are opposite to those of the surface around them."""
    around, own = _normals(mesh)
    a, b, c = (around[mesh.faces[:, k]] for k in range(3))
    return np.einsum("ij,ij->i", own, a + b + c) < 0


def _normals(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    return surface_ops.normals(
        np.ascontiguousarray(mesh.faces, np.int64), np.ascontiguousarray(mesh.vertices, np.float64)
    )
