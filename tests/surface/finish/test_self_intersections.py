"""Faces pierced by edges, compared with all pairs in exact arithmetic."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from helpers.surfaces import grid, join, sphere

from linprim_geo.geometry.mesh import Mesh
from linprim_geo.kernels import ops
from linprim_geo.surface.finish.self_intersections import crossings, edges_of


def by_all_pairs(mesh: Mesh) -> list[int]:
    """Test each face against each edge with fractions."""
    corners = [[Fraction(float(x)) for x in vertex] for vertex in mesh.vertices]

    def volume(*rows: int) -> Fraction:
        a, b, c, d = (corners[row] for row in rows)
        p, q, r = ([x - y for x, y in zip(end, a, strict=True)] for end in (b, c, d))
        cross = [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]]
        return sum((x * y for x, y in zip(cross, r, strict=True)), Fraction(0))

    faces = mesh.faces.tolist()
    edges = {tuple(sorted((face[k], face[k - 1]))) for face in faces for k in range(3)}
    found = set()
    for number, (a, b, c) in enumerate(faces):
        for p, q in edges:
            if {p, q} & {a, b, c} or volume(a, b, c, p) * volume(a, b, c, q) >= 0:
                continue
            around = [volume(p, q, a, b), volume(p, q, b, c), volume(p, q, c, a)]
            if min(around) > 0 or max(around) < 0:
                found.add(number)
    return sorted(found)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e5])
def test_random_triangles_agree_with_all_pairs(scale):
    vertices = scale * np.random.default_rng(3).normal(size=(60, 3))
    mesh = Mesh(vertices, np.arange(60).reshape(-1, 3))
    expected = by_all_pairs(mesh)
    assert 5 < len(expected) < 20 and np.unique(crossings(mesh)[0]).tolist() == expected


def test_overlapping_spheres_agree_with_all_pairs():
    mesh = join(sphere(rounds=2), sphere(rounds=2, center=(0.9, 0.31, 0.17)))
    expected = by_all_pairs(mesh)
    assert len(expected) > 10 and np.unique(crossings(mesh)[0]).tolist() == expected


def test_a_fold_agrees_with_all_pairs():
    mesh = grid(6, 6, size=(1.0, 1.0))
    middle = np.flatnonzero(np.abs(mesh.vertices[:, :2] - 0.5).max(1) < 0.01)[0]
    folded = mesh.vertices.copy()
    folded[middle] += [0.4, 0.05, 0.01]
    folded[:, 2] += 0.05 * np.sin(9 * folded[:, 0])
    mesh = replace(mesh, vertices=folded)
    expected = by_all_pairs(mesh)
    assert expected and np.unique(crossings(mesh)[0]).tolist() == expected


@pytest.mark.parametrize("mesh", [sphere(rounds=4), grid(30, 20), join(grid(), grid(height=1e-3))])
def test_simple_surfaces_have_no_crossings(mesh):
    assert len(crossings(mesh)[0]) == 0


@pytest.mark.parametrize("offset", [0.0, 1e4])
def test_coplanar_overlapping_faces_do_not_count(offset):
    """Points of a tilted plane are rounded in float64, so overlapping faces cross by rounding errors."""
    rng = np.random.default_rng(5)
    across = np.linalg.qr(rng.normal(size=(3, 3)))[0][:2]
    mesh = Mesh(offset + rng.uniform(-1, 1, (300, 2)) @ across, np.arange(300).reshape(-1, 3))
    assert len(crossings(mesh)[0]) == 0
    lifted = mesh.vertices + np.outer(rng.uniform(-1e-9, 1e-9, 300), np.cross(*across))
    assert len(crossings(replace(mesh, vertices=lifted))[0]) > 100


def test_pairs_are_sorted_and_do_not_depend_on_threads():
    mesh = join(sphere(rounds=5), sphere(rounds=5, center=(0.9, 0.31, 0.17)))
    edges, before = edges_of(mesh.faces), ops.threads()
    try:
        found = []
        for count in (1, 3):
            ops.set_threads(count)
            found.append(crossings(mesh, edges))
    finally:
        ops.set_threads(before)
    assert all(np.array_equal(one, other) for one, other in zip(*found, strict=True))
    face, ends = found[0]
    place = {tuple(end): row for row, end in enumerate(edges.tolist())}
    pairs = [(place[tuple(end)], number) for end, number in zip(ends.tolist(), face.tolist(), strict=True)]
    assert len(pairs) > 100 and pairs == sorted(set(pairs))


def test_only_the_given_edges_are_tested():
    mesh = join(sphere(rounds=2), sphere(rounds=2, center=(0.9, 0.31, 0.17)))
    face, ends = crossings(mesh)
    some = np.unique(ends, axis=0)[::2]
    asked = (ends[:, None] == some).all(2).any(1)
    few = crossings(mesh, some)
    assert asked.any() and np.array_equal(few[0], face[asked]) and np.array_equal(few[1], ends[asked])
    assert len(crossings(mesh, some[:0])[0]) == 0


def test_wrong_arrays_are_refused():
    ball = sphere()
    with pytest.raises(ValueError, match="not finite"):
        crossings(replace(ball, vertices=np.where(ball.vertices > 0.99, np.nan, ball.vertices)))
    with pytest.raises(ValueError, match="corners are outside of the vertices"):
        crossings(replace(ball, faces=ball.faces + 1))
    with pytest.raises(ValueError, match="ends are outside of the vertices"):
        crossings(ball, edges_of(ball.faces) - 1)
