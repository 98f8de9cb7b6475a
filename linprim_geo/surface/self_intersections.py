"""Where a surface goes through itself."""

from __future__ import annotations

import numpy as np

from linprim_geo.base.sorting import distinct
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.geometry.raycast import RayCaster

HITS = 8
"""Faces that are looked at along an edge."""


def edges_of(faces: np.ndarray) -> np.ndarray:
    """(E, 2) int64 vertices of the edges of (F, 3) faces, each once, the lower number first, in order."""
    start, end = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    count = int(faces.max(initial=0)) + 1
    return np.stack(np.divmod(distinct(np.minimum(start, end) * count + np.maximum(start, end)), count), axis=1)


def crossings(mesh: Mesh, edges: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Faces that an edge crosses with which they share no vertex: (N,) numbers of faces and (N, 2) ends of edges.

    Rays along the edges find them in single precision, float64 decides. Faces that only touch or lie in one plane do
    not count. Missed may be what comes after HITS other faces along an edge, and crossings within a thousandth of an
    edge of its ends, or a millionth of the diagonal. Faces without area are crossed by nothing.

    Args:
        edges: (E, 2) of `edges_of` that are looked along; None for all.
    """
    vertices, faces = mesh.vertices.astype(np.float64), mesh.faces
    ends = edges_of(faces) if edges is None else edges
    caster = RayCaster(vertices, faces)
    along = vertices[ends[:, 1]] - vertices[ends[:, 0]]
    # Past the faces around the vertex that the edge starts from, by what single precision tells apart.
    step = np.maximum(1e-3, 2e-6 * caster.diagonal / np.maximum(np.linalg.norm(along, axis=1), 1e-300))
    reached, rows, found = step.copy(), np.flatnonzero(step < 1), []
    for _ in range(HITS):
        if len(rows) == 0:
            break
        start = vertices[ends[rows, 0]] + reached[rows, None] * along[rows]
        distance, face, _ = caster.cast_single(start, along[rows])
        hit = reached[rows] + distance < 1
        rows, distance, face = rows[hit], distance[hit], face[hit]
        reached[rows] += distance + step[rows]
        apart = (faces[face][:, :, None] != ends[rows][:, None, :]).all((1, 2))
        edge, face = ends[rows[apart]], face[apart].astype(np.int64)
        through = _crosses(vertices[edge], vertices[faces[face]])
        found.append((face[through], edge[through]))
        rows = rows[reached[rows] < 1]
    if not found:
        return np.zeros(0, np.int64), np.zeros((0, 2), np.int64)
    face, edge = (np.concatenate(part) for part in zip(*found, strict=True))
    return face, edge


def _crosses(segments: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(N,) bool: whether a segment (N, 2, 3) goes through the inside of a triangle (N, 3, 3). Source: signs of the
    volumes of tetrahedra, as in Segura and Feito 2001."""

    def volume(a, b, c, d):
        return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a)

    (p, q), (a, b, c) = segments.swapaxes(0, 1), triangles.swapaxes(0, 1)
    beside = np.sign([volume(p, q, a, b), volume(p, q, b, c), volume(p, q, c, a)])
    return (volume(a, b, c, p) * volume(a, b, c, q) < 0) & (np.abs(beside.sum(0)) == 3)
