"""Moves of vertices that fold no face over and push none through another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from linprim_geo.base.sorting import distinct
from linprim_geo.geometry.mesh import Mesh, face_normals, vertex_normals
from linprim_geo.surface.self_intersections import crossings, edges_of

FOLD_ROUNDS, ROUNDS = 3, 8
"""In which vertices give moves back that fold a face over, and that push one through another."""

REACH = 4.0
"""How far around what moved crossings are looked for, in median edges; and around what was given back anew, before all
these edges are again."""


def moved_safely(mesh: Mesh, vertices: np.ndarray) -> Mesh:
    """The mesh with its vertices moved towards (V, 3) `vertices`, as far as it does no harm, and normals anew.

    Where a face faces away from what is around it, its vertices give half of their move back, FOLD_ROUNDS times. Where
    an edge pierces a face with which it shares no vertex, the vertices of both give all of it back, and their
    neighbours half, ROUNDS times: then no face is pierced that was not before, as a rule. Memory: some 200 bytes per
    vertex.
    """
    start, faces = mesh.vertices.astype(np.float64), mesh.faces
    moves, share = vertices - start, np.ones(len(start))

    def moved() -> Mesh:
        return replace(mesh, vertices=start + share[:, None] * moves)

    for _ in range(FOLD_ROUNDS):
        folded = _folded(moved())
        if not share[faces[folded]].any():
            break
        share[faces[folded]] *= 0.5
    moving = faces[(moves[faces] != 0).any((1, 2))]
    edges = _near(moved().vertices, edges_of(faces), moving)
    some = edges
    for _ in range(ROUNDS):
        pierced, piercing = crossings(moved(), some)
        at = np.union1d(faces[pierced], piercing)
        if share[at].any():
            touched = np.zeros(len(start), bool)
            touched[at] = True
            around = faces[touched[faces].any(1)]
            share[around] *= 0.5
            share[at] = 0
            some = _near(moved().vertices, edges, around)
        elif some is edges:
            break
        else:
            some = edges
    mesh = moved()
    return replace(mesh, normals=vertex_normals(mesh))


def _folded(mesh: Mesh) -> np.ndarray:
    """(F,) bool: faces whose normals are opposite to those of the surface around them."""
    around = vertex_normals(mesh)[mesh.faces].sum(1)
    return np.einsum("ij,ij->i", face_normals(mesh), around) < 0


def _near(vertices: np.ndarray, edges: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The edges with an end in the cells, REACH edges wide, around the vertices of `rows`, or in those beside them."""
    length = np.median(np.linalg.norm(vertices[edges[:, 1]] - vertices[edges[:, 0]], axis=1))
    cells = np.floor((vertices - vertices.min(0)) / (REACH * max(length, 1e-300))).astype(np.int64) + 1
    size = cells.max(0) + 2
    beside = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    wanted = distinct(
        (cells[distinct(rows.ravel())][:, None] + beside).reshape(-1, 3) @ [size[1] * size[2], size[2], 1]
    )
    near = np.isin(cells @ [size[1] * size[2], size[2], 1], wanted)
    return edges[near[edges].any(1)]
