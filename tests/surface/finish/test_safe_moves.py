"""Vertex moves that flip no faces and cause no self-intersections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from helpers.surfaces import join, sphere
from helpers.textured_plane import sheet

from linprim_geo.geometry.mesh import Mesh, face_normals
from linprim_geo.surface.finish.safe_moves import moved_safely, untangled
from linprim_geo.surface.finish.self_intersections import crossings
from linprim_geo.surface.normals import vertex_normals


def test_harmless_moves_are_applied():
    ball = sphere(rounds=4)
    wanted = ball.vertices * 1.1 + [0.2, 0, 0]
    found = moved_safely(ball, wanted)
    assert np.allclose(found.vertices, wanted, rtol=0, atol=1e-12)
    assert np.abs(found.normals - ball.vertices).max() < 0.01


def test_moves_that_make_sheets_cross_are_undone():
    lower = sheet(lambda x, y: 0 * x)
    upper = replace(lower, vertices=lower.vertices + [0.003, 0.002, 0.01])
    mesh = join(lower, upper)
    rng = np.random.default_rng(0)
    wanted = mesh.vertices + np.outer(rng.uniform(-0.008, 0.008, len(mesh.vertices)), [0, 0, 1])
    assert len(crossings(replace(mesh, vertices=wanted))[0]) > 50
    found = moved_safely(mesh, wanted)
    assert len(crossings(found)[0]) == 0
    assert np.mean(np.isclose(found.vertices, wanted).all(1)) > 0.2
    # Vertices whose faces would cross the other sheet do not move.
    pierced = mesh.faces[np.unique(crossings(replace(mesh, vertices=wanted))[0])]
    assert np.array_equal(found.vertices[pierced], mesh.vertices[pierced])


def test_existing_crossings_do_not_block_other_parts():
    knot, far = join(sphere(), sphere(center=(1.0, 0.1, 0.2))), sphere(center=(9.0, 0, 0))
    mesh = join(knot, far)
    wanted = mesh.vertices + [0, 0, 0.01]
    found = moved_safely(mesh, wanted)
    assert np.allclose(found.vertices[-len(far.vertices) :], wanted[-len(far.vertices) :], rtol=0, atol=1e-12)


def test_a_move_that_would_flip_faces_is_shortened():
    mesh = sheet(lambda x, y: 0 * x, steps=9)
    middle = np.abs(mesh.vertices).max(1).argmin()
    wanted = mesh.vertices.copy()
    wanted[middle, 0] += 0.2  # beyond its neighbour at a distance of 0.125
    folded = (face_normals(replace(mesh, vertices=wanted))[:, 2] < 0).sum()
    found = moved_safely(mesh, wanted)
    assert folded > 0 and (face_normals(found)[:, 2] > 0).all()
    assert 0 < found.vertices[middle, 0] < 0.125


def test_no_move_leaves_the_mesh_unchanged():
    mesh = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]]))
    assert np.array_equal(moved_safely(mesh, mesh.vertices).vertices, mesh.vertices)


def test_untangle_removes_crossings_by_local_smoothing():
    """A spike of a noisy sheet pierces the sheet below it."""
    rng = np.random.default_rng(0)
    lower, upper = sheet(lambda x, y: 0 * x), sheet(lambda x, y: 0.03 + 0 * x)
    rough = upper.vertices + np.outer(rng.uniform(-0.005, 0.005, len(upper.vertices)), [0, 0, 1])
    middle = np.linalg.norm(rough[:, :2], axis=1).argmin()
    rough[middle] += [0.002, 0.001, -0.05]
    mesh = join(lower, replace(upper, vertices=rough + [0.0031, 0.0017, 0]))
    assert len(crossings(mesh)[0]) > 3
    found = untangled(mesh)
    assert len(crossings(found)[0]) == 0
    moved = (found.vertices != mesh.vertices).any(1)
    assert 0 < moved.sum() < 40 and moved[len(lower.vertices) + middle]
    assert np.allclose(found.normals, vertex_normals(found))


def test_untangle_keeps_meshes_without_crossings():
    ball = sphere(rounds=4)
    assert np.array_equal(untangled(ball).vertices, ball.vertices)


def test_untangle_reduces_crossings_of_noisy_sheets():
    lower = sheet(lambda x, y: 0 * x)
    mesh = join(lower, replace(lower, vertices=lower.vertices + [0.003, 0.002, 0.004]))
    rng = np.random.default_rng(0)
    mesh = replace(mesh, vertices=mesh.vertices + np.outer(rng.normal(0, 0.004, len(mesh.vertices)), [0, 0, 1]))
    before, after = (len(np.unique(crossings(m)[0])) for m in (mesh, untangled(mesh)))
    assert before > 500 and after < 0.3 * before
