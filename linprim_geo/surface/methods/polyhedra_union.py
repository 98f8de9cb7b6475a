"""Unites many convex polyhedra into one closed surface that records the owner of each face, and selects its shells
(connected components)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.mesh import Mesh

GROUP = 64
"""Neighbouring bodies that are united at a time; then as many of the results, and so on. One call for all takes four
times as long."""

MORTON_BITS = 16
"""Bits per axis of the cell of a Morton code, by which polyhedra are ordered so that neighbours are united first."""


def convex_piece(points: np.ndarray):
    """Return the convex hull of (P, 3) points as a `manifold3d.Manifold` with its own identity, or None if it has no
    volume."""
    import manifold3d

    body = manifold3d.Manifold.hull_points(np.ascontiguousarray(points, dtype=np.float64))
    return own_identity(body)


def own_identity(body):
    """Return `body` as an original, whose faces can be found in a union by its `original_id`, or None if it has no
    volume."""
    if body.status().name != "NoError" or body.is_empty() or not body.volume() > 0:
        return None
    return body.as_original()


def unite(pieces: Sequence, owners: Sequence[int], simplify: float = 0.0) -> tuple[Mesh, np.ndarray]:
    """Return the union of the pieces, closed and oriented outwards, and the owner of each of its faces.

    Pieces are united in Morton order of the centres of their bounding boxes, neighbours first; equal ones keep their
    order.

    Args:
        pieces: M manifolds made by `own_identity`.
        owners: (M,) integers that the faces of each piece get.
        simplify: distance by which the surface may move to remove slivers; 0 keeps all.

    Returns: the mesh and (F,) owners.

    Raises:
        LinprimError: there are no pieces, or manifold3d reports that the union is not closed.

    Accuracy: vertices to about 1e-12 of the bounding box; a piece farther away than that times 1e6 spoils it for all.
    """
    import manifold3d

    if not len(pieces):
        raise LinprimError("no polyhedron has a volume, so there is nothing to unite")
    owner_of = {piece.original_id(): owner for piece, owner in zip(pieces, owners, strict=True)}
    middles = np.array([np.reshape(piece.bounding_box(), (2, 3)).mean(0) for piece in pieces])
    bodies = [pieces[i] for i in np.argsort(morton_keys(middles), kind="stable")]
    while len(bodies) > 1:
        united = []
        for start in range(0, len(bodies), GROUP):
            part = manifold3d.Manifold.batch_boolean(bodies[start : start + GROUP], manifold3d.OpType.Add)
            if part.status().name != "NoError":
                raise LinprimError(f"manifold3d cannot unite the polyhedra: {part.status().name}")
            united.append(part)
        bodies = united
    body = bodies[0].simplify(simplify) if simplify > 0 else bodies[0]
    out = body.to_mesh64()
    starts: np.ndarray = np.asarray(out.run_index).astype(np.int64)
    runs = np.diff(starts) // 3
    face_owner = np.repeat([owner_of[int(i)] for i in out.run_original_id], runs).astype(np.int64)
    return Mesh(np.array(out.vert_properties[:, :3]), np.array(out.tri_verts, dtype=np.int64)), face_owner


def morton_keys(points: np.ndarray) -> np.ndarray:
    """Return the (P,) uint64 Morton codes of (P, 3) finite points in their bounding cube."""
    low, high = points.min(0), points.max(0)
    size = float((high - low).max()) or 1.0
    cell = ((points - low) / size * ((1 << MORTON_BITS) - 1)).astype(np.uint64)
    keys = np.zeros(len(points), dtype=np.uint64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            keys |= ((cell[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return keys


def kept_shells(mesh: Mesh, wanted: np.ndarray) -> np.ndarray:
    """Choose the faces to keep, so that every wanted shell stays and the surface still bounds a body.

    A shell is a connected component of a closed surface: the outside of a body, or a cavity in one. An unwanted shell
    is dropped (which fills a cavity) unless a wanted one lies within it.

    Args:
        mesh: closed, of disjoint shells.
        wanted: (S,) bool by `shells`.

    Returns: (F,) bool.
    """
    count, label = shells(mesh)
    keep = np.array(wanted, dtype=bool)
    corners = mesh.vertices[mesh.faces]
    rows = np.argsort(label, kind="stable")
    starts = np.searchsorted(label[rows], np.arange(count + 1))
    low = np.minimum.reduceat(corners.min(1)[rows], starts[:-1])
    high = np.maximum.reduceat(corners.max(1)[rows], starts[:-1])
    for inner in np.flatnonzero(wanted):
        around = (low <= low[inner]).all(1) & (high >= high[inner]).all(1) & ~keep
        point = corners[rows[starts[inner]]].mean(0)
        for outer in np.flatnonzero(around):
            if _encloses(corners[rows[starts[outer] : starts[outer + 1]]], point):
                keep[outer] = True
    return keep[label]


def shells(mesh: Mesh) -> tuple[int, np.ndarray]:
    """Return the number of connected components and the (F,) component of each face, numbered in order of their first
    face."""
    from linprim_geo.geometry.mesh import face_components

    count, label = face_components(mesh)
    _, first = np.unique(label, return_index=True)
    number = np.empty(count, dtype=np.int64)
    number[np.argsort(first)] = np.arange(count)
    return count, number[label]


def _encloses(corners: np.ndarray, point: np.ndarray) -> bool:
    """Return whether a closed surface of (F, 3, 3) triangles winds around a point, by its solid angle.

    Source: van Oosterom and Strackee, The solid angle of a plane triangle, 1983.
    """
    a, b, c = (corners[:, k] - point for k in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    triple = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = [np.einsum("ij,ij->i", x, y) for x, y in ((a, b), (b, c), (c, a))]
    angle = np.arctan2(triple, la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb)
    return abs(2 * angle.sum()) > 2 * np.pi
