"""Lattice, thinned, averaged and independent points, compared with direct implementations and closed forms."""

import math

import numpy as np
import pytest
from helpers.surfaces import grid, sphere

from linprim_geo.eval.protocols.point_sets import cell_means, lattice_points, thin
from linprim_geo.eval.surface_samples import PointDistance, SurfaceDistance, sample_surface
from linprim_geo.geometry.mesh import Mesh


def test_a_lattice_has_one_point_per_cell_of_the_area_inside_the_faces():
    mesh = sphere(1.0, 2)
    corners = mesh.vertices[mesh.faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    points = lattice_points(mesh, 0.01)
    # A face loses up to a row of cells along two edges of its own, some 30 cells long.
    assert 0.93 * area.sum() / 1e-4 < len(points) < area.sum() / 1e-4
    assert SurfaceDistance(mesh).query(points)[0].max() < 1e-14
    assert len(lattice_points(mesh, 2.0)) == 0  # faces too small for a cell: the vertices alone are left
    one = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    expected = [(i, j) for i in (0.125, 0.375, 0.625, 0.875) for j in (0.125, 0.375, 0.625, 0.875) if i + j < 1]
    assert lattice_points(one, 0.25)[:, :2].tolist() == [list(pair) for pair in expected]


@pytest.mark.parametrize("start", [7, 60, 10**6])
def test_thinning_agrees_with_sequential_removal(monkeypatch, start):
    monkeypatch.setattr("linprim_geo.eval.protocols.point_sets.THIN_START", start)
    random = np.random.default_rng(1)
    points = np.concatenate([random.random((300, 3)), 0.1 * random.integers(0, 4, (100, 3))])  # repeats, and ties
    for radius in (0.1, 0.25):
        order = np.random.default_rng((3, 0)).permutation(len(points))
        removed, stays = np.zeros(len(points), bool), []
        centred = points - points.mean(axis=0)
        for index in order:
            if not removed[index]:
                stays.append(index)
                removed |= np.linalg.norm(centred - centred[index], axis=1) <= radius
        assert thin(points, radius, (3, 0)).tolist() == sorted(stays)
    assert len(thin(points, 5.0, 0)) == 1 and len(thin(points[:0], 0.1, 0)) == 0


def test_cell_means_agree_with_a_direct_implementation():
    points = np.random.default_rng(0).random((500, 3)) + [1e6, 0, -3]
    low = points.min(axis=0)
    cells = {}
    for point in points:
        cells.setdefault(tuple(np.floor((point - low) / 0.3 + 0.5)), []).append(point - low)
    expected = np.array([np.mean(cells[key], axis=0) + low for key in sorted(cells)])
    assert cell_means(points, 0.3) == pytest.approx(expected, abs=1e-9)
    assert len(cell_means(points, 1e-9)) == 500  # more cells than an index of 64 bits would count


def test_mean_distance_of_independent_points_agrees_with_a_poisson_process():
    mesh, count = grid(7, 5), 20_000
    points = [sample_surface(mesh, count, seed, independent=True)[0] for seed in (1, 2)]
    distance = PointDistance(points[0]).query(points[1])[0]
    # Mean distance of a Poisson process of density N / A: the integral of exp(-pi r^2 N / A). The border of
    # the rectangle, where neighbours are on one side only, adds about 1 %.
    assert distance.mean() == pytest.approx(0.5 * math.sqrt(2.0 / count), rel=0.025)
