"""Union of many convex polyhedra as one closed surface whose faces know where they come from, and its connected
shells."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.mesh import Mesh

GROUP = 64
"""Neighbours that are united at a time; then as many of these, and so on: one call for all takes four times as long."""

MORTON_BITS = 16
"""Bits per axis of the cell that decides which polyhedra are neighbours."""


def convex_piece(points: np.ndarray):
    """The convex hull of (P, 3) points as a `manifold3d.Manifold` of its own identity, or None if it has no volume."""
    import manifold3d

    body = manifold3d.Manifold.hull_points(np.ascontiguousarray(points, dtype=np.float64))
    return own_identity(body)


def own_identity(body):
    """`body` as an original, by whose `original_id` its faces are found in a union, or None if it has no volume."""
    if body.status().name != "NoError" or body.is_empty() or not body.volume() > 0:
        return None
    return body.as_original()


def unite(pieces: Sequence, owners: Sequence[int], simplify: float = 0.0) -> tuple[Mesh, np.ndarray]:
    """The union of pieces, closed and oriented outward, and the owner of each of its faces.

    Pieces are united in Morton order of the middles of their boxes, neighbours first; equal places keep their order.

    Args:
        pieces: M manifolds made by `own_identity`.
        owners: (M,) integers that the faces of each piece get.
        simplify: the surface may move by this to get rid of slivers; 0 keeps all.

    Returns: the mesh and (F,) owners.

    Raises:
        LinprimError: there are no pieces, or manifold3d reports that the union is not closed.

    Accuracy: vertices to about 1e-12 of the bounding box; a piece further away than that times 1e6 spoils it for all.
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
    """(P,) uint64 place of each of (P, 3) finite points along a Morton curve through their bounding cube."""
    low, high = points.min(0), points.max(0)
    size = float((high - low).max()) or 1.0
    cell = ((points - low) / size * ((1 << MORTON_BITS) - 1)).astype(np.uint64)
    keys = np.zeros(len(points), dtype=np.uint64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            keys |= ((cell[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return keys


def kept_shells(mesh: Mesh, wanted: np.ndarray) -> np.ndarray:
    """Which faces stay so that every wanted shell does and the surface still bounds a body.

    A shell is a connected piece of a closed surface: the outside of a body, or a cavity of one. A shell that is not
    wanted is dropped (a cavity is filled by that) unless a wanted one lies within it.

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
    """Number of connected pieces and the (F,) piece of each face, numbered in order of their first face."""
    from linprim_geo.geometry.mesh import face_components

    count, label = face_components(mesh)
    _, first = np.unique(label, return_index=True)
    number = np.empty(count, dtype=np.int64)
    number[np.argsort(first)] = np.arange(count)
    return count, number[label]


def _encloses(corners: np.ndarray, point: np.ndarray) -> bool:
    """Whether a closed surface of (F, 3, 3) triangles winds around a point.

    Source: van Oosterom and Strackee, The solid angle of a plane triangle, 1983.
    """
    a, b, c = (corners[:, k] - point for k in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    triple = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = [np.einsum("ij,ij->i", x, y) for x, y in ((a, b), (b, c), (c, a))]
    angle = np.arctan2(triple, la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb)
    return abs(2 * angle.sum()) > 2 * np.pi
