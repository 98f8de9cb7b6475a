"""Vertex normals and folded faces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.surfaces import grid, sphere

from linprim_geo.geometry.mesh import Mesh, face_normals
from linprim_geo.kernels import ops
from linprim_geo.surface.normals import folded, vertex_normals

CUBE = Mesh(
    np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64),
    np.array(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
        + [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    ),
)


def test_vertex_normals_of_a_sphere():
    ball = sphere(rounds=4)
    edge = np.linalg.norm(ball.vertices[ball.faces[:, 0]] - ball.vertices[ball.faces[:, 1]], axis=1).max()
    # First-order errors of the faces around a vertex cancel; what is left goes with the square of the edge.
    assert np.abs(vertex_normals(ball) - ball.vertices).max() < edge**2


def test_vertex_normals_of_a_cube_do_not_depend_on_its_triangulation():
    np.testing.assert_allclose(vertex_normals(CUBE), (CUBE.vertices - 0.5) / np.sqrt(0.75), atol=1e-12)
    lonely = replace(CUBE, vertices=np.concatenate([CUBE.vertices, [[5, 5, 5]]]))
    np.testing.assert_array_equal(vertex_normals(lonely)[8], 0.0)


def test_vertex_normals_agree_with_the_definition():
    """Sum face normals weighted by corner angles, which are not near 0 or pi here."""
    mesh = Mesh(np.random.default_rng(1).normal(size=(20, 3)), sphere(rounds=0).faces)
    expected = np.zeros_like(mesh.vertices)
    for face, normal in zip(mesh.faces, face_normals(mesh), strict=True):
        for k in range(3):
            here, there, back = mesh.vertices[np.roll(face, -k)]
            cosine = (there - here) @ (back - here) / np.linalg.norm(there - here) / np.linalg.norm(back - here)
            expected[face[k]] += np.arccos(cosine) * normal
    length = np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(vertex_normals(mesh), expected / np.where(length > 0, length, 1), atol=1e-12)


def test_results_do_not_depend_on_threads():
    ball = sphere(rounds=6)
    before = ops.threads()
    try:
        found = []
        for count in (1, 2, 3):
            ops.set_threads(count)
            found.append(vertex_normals(ball))
    finally:
        ops.set_threads(before)
    assert np.array_equal(found[0], found[1]) and np.array_equal(found[0], found[2])


def test_folded_faces_are_found():
    mesh = grid(6, 6, size=(1.0, 1.0))
    assert not folded(mesh).any()
    middle = np.abs(mesh.vertices[:, :2] - 0.5).max(1).argmin()
    vertices = mesh.vertices.copy()
    vertices[middle, 0] += 0.3
    bent = replace(mesh, vertices=vertices)
    assert folded(bent).any() and (folded(bent) == (face_normals(bent)[:, 2] < 0)).all()


def test_corners_outside_of_the_vertices_are_refused():
    with pytest.raises(ValueError, match="corners are outside of the vertices"):
        vertex_normals(replace(CUBE, faces=CUBE.faces + 1))
