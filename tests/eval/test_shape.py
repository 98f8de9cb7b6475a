"""Shape scores on surfaces where they are known in closed form."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.surfaces import camera_above, grid, join, sphere

from linprim_geo.eval.mesh import score_mesh
from linprim_geo.eval.shape import (
    angle_scores,
    crease_lines,
    distance_to_lines,
    flat_regions,
    sample_lines,
    triangle_scores,
)
from linprim_geo.geometry.mesh import Mesh


def cube(steps: int = 4, size: float = 1.0) -> Mesh:
    """A cube whose six sides have separate vertices, with outward normals."""
    side, sides = grid(steps, steps, size=(size, size), height=size), []
    for axis in range(3):
        turned = np.roll(side.vertices, axis, axis=1)
        sides += [Mesh(turned, side.faces), Mesh(size - turned[:, [1, 0, 2]], side.faces)]
        if axis:
            sides[-1] = Mesh(size - np.roll(side.vertices[:, [1, 0, 2]], axis, axis=1), side.faces)
    return join(*sides)


def test_a_cube_has_twelve_creases_and_six_planes():
    mesh = cube()
    lines = crease_lines(mesh)
    ends = lines.vertices[lines.faces]
    assert np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum() == pytest.approx(12)
    assert len(lines.faces) == 12 * 4
    region = flat_regions(mesh)
    assert sorted(np.unique(region, return_counts=True)[1]) == [32] * 6
    for number in range(6):
        assert np.ptp(mesh.vertices[mesh.faces[region == number]].reshape(-1, 3), axis=0).min() == 0


def test_a_sphere_has_no_creases_and_no_planes():
    mesh = sphere(rounds=5)
    assert len(crease_lines(mesh).faces) == 0 and (flat_regions(mesh) == -1).all()
    assert np.isinf(distance_to_lines(crease_lines(mesh), mesh.vertices)).all()
    assert sample_lines(crease_lines(mesh), 10, 0).shape == (0, 3)


def test_distances_to_lines_are_exact_and_samples_uniform():
    lines, rng = crease_lines(cube()), np.random.default_rng(0)
    points = rng.uniform(-0.5, 1.5, (300, 3))
    off = np.stack([np.maximum(-points, 0) + np.maximum(points - 1, 0), np.abs(points), np.abs(points - 1)])
    # Along one axis an edge spans 0 to 1, along the other two it is at 0 or 1.
    end = off[1:].min(0)
    expected = np.min([np.sqrt(off[0, :, k] ** 2 + end[:, k - 1] ** 2 + end[:, k - 2] ** 2) for k in range(3)], axis=0)
    assert distance_to_lines(lines, points) == pytest.approx(expected, abs=1e-12)
    samples = sample_lines(lines, 1200, 0)
    assert distance_to_lines(lines, samples).max() < 1e-12
    on_top = (samples[:, 2] > 1 - 1e-9).sum()
    assert on_top == pytest.approx(400, abs=4)  # four of twelve edges


def test_normal_angles_of_a_tilted_plane_are_exact():
    slope = math.tan(math.radians(7))
    flat = grid(5, 4)
    ramp = replace(flat, vertices=flat.vertices + slope * flat.vertices[:, :1] * [0, 0, 1])
    normals = score_mesh(ramp, flat, samples=2000)["shape"]["normals"]
    assert normals["mean"] == pytest.approx(7) and normals["median"] == pytest.approx(7)
    assert normals["share_below_5"] == 0 and normals["share_below_11.25"] == 1
    both = angle_scores([np.array([1.0, -1.0, 0.5]), np.array([0.0])])
    assert both["mean"] == pytest.approx((20 + 90) / 2) and both["share_below_5"] == pytest.approx(1 / 3)
    assert math.isnan(angle_scores([np.zeros(0), np.ones(3)])["mean"])


def test_crease_distance_of_a_shifted_cube_agrees_with_the_closed_form():
    shape = score_mesh(replace(cube(), vertices=cube().vertices + [0.004, 0, 0]), cube(), samples=20_000)["shape"]
    # Four of the twelve edges are parallel to the shift and differ only at their ends.
    assert shape["creases"]["chamfer"] == pytest.approx(0.004 * 8 / 12, rel=0.02)
    assert shape["creases"]["precision"] == shape["creases"]["recall"] == 1
    assert shape["creases"]["chamfer_percent_diagonal"] == pytest.approx(100 * shape["creases"]["chamfer"] / 3**0.5)
    assert shape["flatness"]["rms"] < 1e-12 and shape["flatness"]["planes"] == 6


def test_crease_recall_of_an_open_cube_agrees_with_the_closed_form():
    top = np.flatnonzero((cube().vertices[cube().faces][..., 2] == 1).all(1))
    open_cube = Mesh(cube().vertices, np.delete(cube().faces, top, axis=0))
    shape = score_mesh(open_cube, cube(), samples=20_000)["shape"]
    tau = 0.01 * 3**0.5
    assert shape["creases"]["precision"] == 1
    # The ends of the four vertical edges are within tau of missing edges.
    assert shape["creases"]["recall"] == pytest.approx((8 + 8 * tau) / 12, abs=0.005)
    assert shape["flatness"]["planes"] == 5


def test_flatness_is_the_rms_of_waves_without_offset():
    reference = grid(10, 10)
    fine = grid(200, 100)
    waves = 0.003 * np.sin(8 * np.pi * fine.vertices[:, 0]) + 0.005
    shape = score_mesh(replace(fine, vertices=fine.vertices + np.outer(waves, [0, 0, 1])), reference)["shape"]
    assert shape["flatness"]["planes"] == 1
    assert shape["flatness"]["rms"] == pytest.approx(0.003 / math.sqrt(2), rel=0.01)


def test_visible_shape_scores_ignore_unseen_planes():
    flat = grid(4, 4, size=(2.0, 2.0))
    block = replace(cube(), vertices=cube().vertices * 0.5 + [0.75, 0.75, 0])
    mesh = join(flat, block)
    result = score_mesh(mesh, mesh, samples=5000, cameras=[camera_above(4.0, target=(1.0, 1.0))])
    # The floor and the top of the block; not its sides, nor its bottom.
    assert result["visible"]["shape"]["flatness"]["planes"] == 2 < result["shape"]["flatness"]["planes"]


def test_slivers_and_pierced_faces_are_counted():
    assert triangle_scores(sphere(rounds=3)) == {"sliver_share": 0.0, "self_intersecting": 0}
    thin = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0.5, 0.01, 0], [0, 1, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    assert triangle_scores(thin)["sliver_share"] == 0.5
    assert triangle_scores(join(sphere(), sphere(center=(1.0, 0.1, 0.2))))["self_intersecting"] > 10
