"""Moves vertices without folding faces over or pushing faces through each other, and smooths existing
self-intersections away."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from linprim_geo.base.sorting import distinct
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.surface.finish.photo_consistency import neighbour_average
from linprim_geo.surface.finish.self_intersections import crossings, edges_of
from linprim_geo.surface.normals import folded, vertex_normals

FOLD_ROUNDS, ROUNDS = 3, 8
"""Rounds in which vertices give back moves that fold a face over, and rounds in which they give back moves that push a
face through another. ROUNDS also limits the smoothing of `untangled`."""


def moved_safely(mesh: Mesh, vertices: np.ndarray) -> Mesh:
    """Return the mesh with its vertices moved towards (V, 3) `vertices` as far as this does no harm, with new normals.

    Where a face flips against the surface around it, its vertices give back half of their move, FOLD_ROUNDS times.
    Where an edge pierces a face with which it shares no vertex, the vertices of both give back their whole move and
    their neighbours half, ROUNDS times. After that, as a rule, no face is pierced that was not before. Memory: some 300
    bytes per vertex.
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
    """Return the mesh, smoothed where it intersects itself, until few or no self-intersections are left, with new
    normals.

    Vertices of crossing faces and edges take the mean of themselves and their neighbours, at most ROUNDS times; more
    rounds would widen the holes of thin sheets. Memory: some 400 bytes per vertex.
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
    """Return the vertices of the faces that the (E, 2) `edges` of a mesh pierce, and of these edges, as far as the face
    or the edge has a vertex that has `changed` (V,)."""
    of_changed, some = changed[edges].any(1), Mesh(mesh.vertices, mesh.faces[changed[mesh.faces].any(1)])
    at = [np.zeros(0, np.int64)]
    for others, asked in ((mesh, edges[of_changed]), (some, edges[~of_changed])):
        pierced, piercing = crossings(others, asked)
        at += [others.faces[pierced].ravel(), piercing.ravel()]
    return distinct(np.concatenate(at))
