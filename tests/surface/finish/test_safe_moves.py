"""Moves that fold nothing over and push nothing through another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from helpers.surfaces import join, sphere
from helpers.textured_plane import sheet

from linprim_geo.geometry.mesh import Mesh, face_normals
from linprim_geo.surface.finish.safe_moves import moved_safely, untangled
from linprim_geo.surface.finish.self_intersections import crossings
from linprim_geo.surface.normals import vertex_normals


def test_moves_that_do_no_harm_are_made():
    ball = sphere(rounds=4)
    wanted = ball.vertices * 1.1 + [0.2, 0, 0]
    found = moved_safely(ball, wanted)
    assert np.allclose(found.vertices, wanted, rtol=0, atol=1e-12)
    assert np.abs(found.normals - ball.vertices).max() < 0.01


def test_two_sheets_that_would_cross_stay_apart():
    lower = sheet(lambda x, y: 0 * x)
    upper = replace(lower, vertices=lower.vertices + [0.003, 0.002, 0.01])
    mesh = join(lower, upper)
    rng = np.random.default_rng(0)
    wanted = mesh.vertices + np.outer(rng.uniform(-0.008, 0.008, len(mesh.vertices)), [0, 0, 1])
    assert len(crossings(replace(mesh, vertices=wanted))[0]) > 50
    found = moved_safely(mesh, wanted)
    assert len(crossings(found)[0]) == 0
    assert np.mean(np.isclose(found.vertices, wanted).all(1)) > 0.2
    # What would go through the other sheet does not move at all.
    pierced = mesh.faces[np.unique(crossings(replace(mesh, vertices=wanted))[0])]
    assert np.array_equal(found.vertices[pierced], mesh.vertices[pierced])


def test_crossings_that_there_were_may_stay_and_what_is_apart_moves():
    knot, far = join(sphere(), sphere(center=(1.0, 0.1, 0.2))), sphere(center=(9.0, 0, 0))
    mesh = join(knot, far)
    wanted = mesh.vertices + [0, 0, 0.01]
    found = moved_safely(mesh, wanted)
    assert np.allclose(found.vertices[-len(far.vertices) :], wanted[-len(far.vertices) :], rtol=0, atol=1e-12)


def test_a_vertex_that_would_fold_its_faces_over_goes_part_of_the_way():
    mesh = sheet(lambda x, y: 0 * x, steps=9)
    middle = np.abs(mesh.vertices).max(1).argmin()
    wanted = mesh.vertices.copy()
    wanted[middle, 0] += 0.2  # past its neighbour, 0.125 away
    folded = (face_normals(replace(mesh, vertices=wanted))[:, 2] < 0).sum()
    found = moved_safely(mesh, wanted)
    assert folded > 0 and (face_normals(found)[:, 2] > 0).all()
    assert 0 < found.vertices[middle, 0] < 0.125


def test_nothing_to_move_is_no_trouble():
    mesh = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]]))
    assert np.array_equal(moved_safely(mesh, mesh.vertices).vertices, mesh.vertices)


def test_what_goes_through_itself_is_smoothed_until_it_does_not():
    """A sheet of noise before another one, of which a spike comes through the other."""
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


def test_what_does_not_go_through_itself_stays_as_it_is():
    ball = sphere(rounds=4)
    assert np.array_equal(untangled(ball).vertices, ball.vertices)


def test_sheets_of_noise_through_each_other_have_fewer_places_where_they_are():
    lower = sheet(lambda x, y: 0 * x)
    mesh = join(lower, replace(lower, vertices=lower.vertices + [0.003, 0.002, 0.004]))
    rng = np.random.default_rng(0)
    mesh = replace(mesh, vertices=mesh.vertices + np.outer(rng.normal(0, 0.004, len(mesh.vertices)), [0, 0, 1]))
    before, after = (len(np.unique(crossings(m)[0])) for m in (mesh, untangled(mesh)))
    assert before > 500 and after < 0.3 * before
