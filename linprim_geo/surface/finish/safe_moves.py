"""Moves of vertices that fold no face over and push none through another, and surfaces that have gone through
themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from linprim_geo.base.sorting import distinct
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.surface.finish.photo_consistency import neighbour_average
from linprim_geo.surface.finish.self_intersections import crossings, edges_of
from linprim_geo.surface.normals import folded, vertex_normals

FOLD_ROUNDS, ROUNDS = 3, 8
"""In which vertices give moves back that fold a face over, and that push one through another; in so many as the latter
vertices where a surface goes through itself take the mean of their neighbours."""


def moved_safely(mesh: Mesh, vertices: np.ndarray) -> Mesh:
    """The mesh with its vertices moved towards (V, 3) `vertices`, as far as it does no harm, and normals anew.

    Where a face faces away from what is around it, its vertices give half of their move back, FOLD_ROUNDS times. Where
    an edge pierces a face with which it shares no vertex, the vertices of both give all of it back, and their
    neighbours half, ROUNDS times: then no face is pierced that was not before, as a rule. Memory: some 300 bytes per
    vertex.
    """
    start, faces = mesh.vertices.astype(np.float64), mesh.faces
    moves, share = vertices - start, np.ones(len(start))

    def moved() -> Mesh:
        return replace(mesh, vertices=start + share[:, None] * moves)

    for _ in range(FOLD_ROUNDS):
        over = folded(moved())
        if not share[faces[over]].any():
            break
        share[faces[over]] *= 0.5
    edges = edges_of(faces)
    changed: np.ndarray = np.any(moves, axis=1)
    for _ in range(ROUNDS):
        at = _crossing(moved(), edges, changed)
        if not share[at].any():
            break
        touched = np.zeros(len(start), bool)
        touched[at] = True
        changed = np.zeros(len(start), bool)
        changed[faces[touched[faces].any(1)]] = True
        share[changed] *= 0.5
        share[at] = 0
    mesh = moved()
    return replace(mesh, normals=vertex_normals(mesh))


def untangled(mesh: Mesh) -> Mesh:
    """The mesh, smoother where it goes through itself, until it does so in few places or none; normals are made anew.

    The vertices of faces and edges that cross take the mean of their neighbours, ROUNDS times at most: more of them
    widen the holes that thin sheets have. Memory: some 400 bytes per vertex.
    """
    edges, average = edges_of(mesh.faces), neighbour_average(mesh)
    mesh = replace(mesh, vertices=mesh.vertices.astype(np.float64))
    changed = np.ones(len(mesh.vertices), bool)
    for _ in range(ROUNDS):
        at = _crossing(mesh, edges, changed)
        if len(at) == 0:
            break
        place = mesh.vertices.copy()
        place[at] = average[at] @ place
        changed = np.zeros(len(place), bool)
        changed[at] = True
        mesh = replace(mesh, vertices=place)
    return replace(mesh, normals=vertex_normals(mesh))


def _crossing(mesh: Mesh, edges: np.ndarray, changed: np.ndarray) -> np.ndarray:
    """Vertices of faces that the (E, 2) edges of a mesh pierce, and of these edges, where one of them has `changed`
    (V,)."""
    of_changed, some = changed[edges].any(1), Mesh(mesh.vertices, mesh.faces[changed[mesh.faces].any(1)])
    at = [np.zeros(0, np.int64)]
    for others, asked in ((mesh, edges[of_changed]), (some, edges[~of_changed])):
        pierced, piercing = crossings(others, asked)
        at += [others.faces[pierced].ravel(), piercing.ravel()]
    return distinct(np.concatenate(at))
