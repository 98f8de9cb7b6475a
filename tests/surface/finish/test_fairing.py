"""Fairing of surfaces: a balance of predicted error and bending."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from helpers.textured_plane import sheet

from linprim_geo.geometry.mesh import Mesh, select_faces
from linprim_geo.kernels import ops
from linprim_geo.surface.finish.fairing import BEND, faired


def rough(mesh: Mesh, error: np.ndarray, share: float = 0.5) -> Mesh:
    """The mesh with a predicted error, and noise in height of up to `share` of it."""
    waves = np.sin(60 * mesh.vertices[:, 0]) * np.sin(50 * mesh.vertices[:, 1])
    vertices = mesh.vertices + np.outer(share * error * waves, [0, 0, 1])
    return replace(mesh, vertices=vertices, quality=error.astype(np.float32))


def energy(mesh: Mesh, vertices: np.ndarray) -> float:
    """The energy that `fairing` documents, for a mesh of one piece."""
    edges = {(a, b) for face in mesh.faces for a, b in zip(face, np.roll(face, -1), strict=True)}
    length = np.median([np.linalg.norm(mesh.vertices[a] - mesh.vertices[b]) for a, b in edges])
    neighbours: list[set] = [set() for _ in vertices]
    border: list[set] = [set() for _ in vertices]
    for a, b in edges:
        neighbours[a].add(b), neighbours[b].add(a)
        if (b, a) not in edges:
            border[a].add(b), border[b].add(a)
    total = (((vertices - mesh.vertices) / mesh.quality[:, None]) ** 2).sum()
    for k, around in enumerate(neighbours):
        off = vertices[sorted(border[k] or around)].mean(0) - vertices[k]
        total += (off**2).sum() / (BEND * length) ** 2
    return total


def test_the_energy_is_minimal():
    error = np.random.default_rng(0).uniform(0.02, 0.2, 13 * 13)
    mesh = rough(sheet(lambda x, y: x * y, steps=13), error)
    found = faired(mesh).vertices
    border = np.abs(mesh.vertices[:, :2]).max(1) > 0.49
    least = energy(mesh, found)
    assert least < 0.3 * energy(mesh, mesh.vertices)
    rng = np.random.default_rng(1)
    for _ in range(20):
        change = rng.normal(size=found.shape) * np.outer(~border, [1, 1, 1])
        # Border vertices cannot move along the surface, so that only inner vertices are at the minimum.
        assert energy(mesh, found + 1e-3 * change) > least


def test_uncertain_parts_follow_the_curvature_of_certain_ones():
    def height(x, y):
        return 0.5 * np.sqrt(1 - x**2)

    true = sheet(height, steps=61)
    unsure = (np.abs(true.vertices[:, :2]) < 0.2).all(1)
    error = np.where(unsure, 0.04, 1e-4)
    mesh = rough(true, error)
    found = faired(mesh).vertices
    off, off_then = (np.abs(v[:, 2] - height(v[:, 0], v[:, 1]))[unsure] for v in (mesh.vertices, found))
    assert np.median(off_then) < 0.15 * np.median(off) and off_then.max() < 0.3 * off.max()
    sure = np.abs(found[:, 2] - height(found[:, 0], found[:, 1]))[~unsure]
    assert sure.max() < 2e-4


def test_no_vertex_moves_farther_than_its_error():
    error = np.random.default_rng(2).uniform(1e-4, 0.01, 41 * 41)
    mesh = rough(sheet(lambda x, y: -np.abs(x)), error, share=2.5)
    moved = np.linalg.norm(faired(mesh).vertices - mesh.vertices, axis=1)
    assert (moved <= error * (1 + 1e-6)).all() and (moved > 0.5 * error).any()


def test_a_hole_does_not_grow():
    mesh = sheet(lambda x, y: 0 * x)
    mesh = select_faces(mesh, np.linalg.norm(mesh.vertices[mesh.faces].mean(1), axis=1) > 0.2)
    found = faired(replace(mesh, quality=np.full(len(mesh.vertices), 0.1))).vertices
    border = np.linalg.norm(mesh.vertices, axis=1) < 0.2
    assert border.sum() > 20 and np.abs(found[border] - mesh.vertices[border]).max() < 1e-9


def test_separate_pieces_and_shared_border_vertices_are_handled():
    # Two triangles that share a corner, and one by itself.
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [5, 0, 0], [6, 0, 0], [5, 1, 0]])
    mesh = Mesh(vertices.astype(float), np.array([[0, 1, 2], [0, 3, 4], [5, 6, 7]]), quality=np.full(8, 0.01))
    found = faired(mesh).vertices
    assert np.isfinite(found).all() and np.abs(found[:, 2]).max() == 0


def test_results_do_not_depend_on_threads():
    mesh = rough(sheet(lambda x, y: x * y), np.full(41 * 41, 0.02))
    before, found = ops.threads(), []
    try:
        for count in (1, 2):
            ops.set_threads(count)
            found.append(faired(mesh).vertices)
    finally:
        ops.set_threads(before)
    assert np.array_equal(*found)
