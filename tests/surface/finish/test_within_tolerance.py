"""Simplification within a tolerance of the distance from removed vertices to the new surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.surfaces import grid, join, sphere

from linprim_geo.base.options import ExtractOptions
from linprim_geo.eval.surface_samples import SurfaceDistance
from linprim_geo.geometry.mesh import Mesh, face_areas, select_faces
from linprim_geo.geometry.mesh_files import load_mesh
from linprim_geo.geometry.topology import topology
from linprim_geo.kernels import surface_ops
from linprim_geo.surface.extract import extract_mesh
from linprim_geo.surface.finish.mesh_process import process_mesh, within_tolerance


def off(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    return SurfaceDistance(mesh).query(points)[0]


def square(steps: int, side: float) -> Mesh:
    return grid(steps, steps, (side, side))


def welded(mesh: Mesh) -> Mesh:
    """Merge vertices with equal coordinates."""
    _, first, row = np.unique(np.round(mesh.vertices, 9), axis=0, return_index=True, return_inverse=True)
    return Mesh(mesh.vertices[first], row.reshape(-1)[mesh.faces])


def cube(steps: int) -> Mesh:
    """A closed cube of side 2 with `steps` squares along each edge."""
    side = square(steps, 2.0)
    x, y = (side.vertices[:, :2] - side.vertices[:, :2].mean(0)).T
    sides = []
    for axis in range(3):
        for end in (-1.0, 1.0):
            places = np.empty((len(x), 3))
            places[:, axis], places[:, axis - 2], places[:, axis - 1] = end, end * x, y
            sides.append(Mesh(places, side.faces))
    return welded(join(*sides))


def noisy(mesh: Mesh, deviation: float, seed: int = 0) -> Mesh:
    rng = np.random.default_rng(seed)
    return replace(mesh, vertices=mesh.vertices + rng.normal(0, deviation, mesh.vertices.shape))


def least_angles(mesh: Mesh) -> np.ndarray:
    """(F,) smallest angle of each face in degrees."""
    corners = mesh.vertices[mesh.faces]
    sides = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    ordered = np.sort(sides, axis=1)
    return np.degrees(np.arcsin(np.clip(2 * face_areas(mesh) / (ordered[:, 1] * ordered[:, 2]), 0, 1)))


def same_shape(one: Mesh, other: Mesh) -> bool:
    names = ("components", "watertight", "genus", "non_manifold_edges")
    return [topology(one)[name] for name in names] == [topology(other)[name] for name in names]


@pytest.mark.parametrize("tolerance", [0.001, 0.01, 0.1])
@pytest.mark.parametrize(
    "mesh",
    [noisy(sphere(rounds=4), 0.004), noisy(square(40, 2.0), 0.004), noisy(cube(20), 0.004)],
    ids=["sphere", "sheet", "cube"],
)
def test_removed_vertices_are_within_the_tolerance(mesh, tolerance):
    made = within_tolerance(mesh, tolerance)
    assert off(made, mesh.vertices).max() <= tolerance * (1 + 1e-9)
    assert same_shape(made, mesh) and len(made.faces) < len(mesh.faces)


def test_each_vertex_has_its_own_tolerance():
    mesh = sphere(rounds=5)
    error = np.where(mesh.vertices[:, 2] > 0, 0.02, 0.0004).astype(np.float32)
    made, (step,) = process_mesh(replace(mesh, quality=error), ExtractOptions(tolerance="auto"))
    assert (off(made, mesh.vertices) <= 0.5 * error * (1 + 1e-6)).all()
    upper = made.vertices[made.faces].mean(1)[:, 2] > 0
    assert 10 * np.count_nonzero(upper) < np.count_nonzero(~upper)
    assert "within 0.5 of the predicted errors" in step["note"] and step["tolerance"] == "auto"


def test_vertices_without_a_predicted_error_have_the_median():
    mesh = sphere(rounds=4)
    error = np.full(len(mesh.vertices), 0.01, np.float32)
    error[::3] = np.nan
    made = within_tolerance(replace(mesh, quality=error), "auto")
    assert len(made.faces) < len(mesh.faces) and off(made, mesh.vertices).max() <= 0.005 * (1 + 1e-6)


def test_flat_sides_become_two_faces_each():
    mesh = cube(24)
    made = within_tolerance(mesh, 1e-6)
    assert len(made.faces) == 12 and topology(made)["volume"] == pytest.approx(8.0, abs=24 * 1e-6)
    assert np.abs(made.vertices) == pytest.approx(np.ones((8, 3)), abs=2e-6)


def test_corners_of_a_rough_cube_stay_sharp():
    mesh = noisy(cube(24), 0.001)
    made = within_tolerance(mesh, 0.005)
    assert len(made.faces) < len(mesh.faces) / 50
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    assert off(made, corners).max() < 0.008


def test_number_of_faces_of_a_sphere_is_inverse_to_the_tolerance():
    """The error of a chord grows with its squared length, so the number of faces is inverse to the tolerance."""
    mesh = sphere(rounds=6)
    counts = [len(within_tolerance(mesh, tolerance).faces) for tolerance in (0.001, 0.004, 0.016)]
    for fine, coarse in zip(counts, counts[1:], strict=False):
        assert 2.5 < fine / coarse < 6
    # A regular triangle of side s that touches a sphere of radius 1 in its middle, or in its corners, is off by s^2/6:
    # with both halves of the tolerance used, by s^2/12.
    ideal = 4 * np.pi / (np.sqrt(3) / 4 * 12 * 0.001)
    assert ideal < counts[0] < 3 * ideal


def test_smallest_angles_are_above_10_degrees():
    angles = least_angles(within_tolerance(noisy(sphere(rounds=5), 0.0005), 0.003))
    assert angles.min() > 9.9 and np.median(angles) > 30


def test_borders_stay_within_the_tolerance():
    """The border of the hole in a frame may neither grow nor shrink."""
    whole = square(60, 2.0)
    middle = whole.vertices[whole.faces].mean(1)[:, :2] - whole.vertices[:, :2].mean(0)
    frame = select_faces(whole, np.hypot(*middle.T) > 0.5)
    made = within_tolerance(frame, 0.02)
    assert len(made.faces) < len(frame.faces) / 15 and same_shape(made, frame)
    assert topology(made)["boundary_edges"] < topology(frame)["boundary_edges"] / 2
    length = np.pi * 1.0 + 8.0
    assert abs(face_areas(made).sum() - face_areas(frame).sum()) < 0.02 * length
    assert off(frame, made.vertices[made.faces].mean(1)).max() < 0.02


def test_holes_and_pieces_are_kept_at_any_tolerance():
    """The tolerance is very large. The mesh has two balls, and a sheet with a hole of one face."""
    sheet = square(12, 2.0)
    mesh = join(sphere(rounds=3), sphere(center=(5.0, 0, 0), rounds=3), select_faces(sheet, np.arange(288) != 150))
    made = within_tolerance(mesh, 10.0)
    assert same_shape(made, mesh) and topology(made)["boundary_edges"] >= 6
    assert len(made.faces) < 40


def test_non_manifold_vertices_and_edges_are_kept():
    ball, other = sphere(rounds=3), sphere(rounds=3, center=(0, 0, 2.0))
    touching = welded(join(ball, other))
    made = within_tolerance(touching, 0.2)
    assert len(made.faces) < len(touching.faces) / 4
    assert np.linalg.norm(made.vertices - [0, 0, 1.0], axis=1).min() < 1e-9
    sheet = square(8, 1.0)
    turned = (
        replace(sheet, vertices=sheet.vertices @ np.diag([-1.0, 1, 1])),
        replace(sheet, vertices=sheet.vertices[:, [2, 1, 0]]),
    )
    book = welded(join(sheet, *turned))
    assert topology(book)["non_manifold_edges"] == 8
    assert topology(within_tolerance(book, 0.1))["non_manifold_edges"] == 8


def test_no_face_is_turned_inside_out():
    mesh = noisy(sphere(rounds=5), 0.002)
    made = within_tolerance(mesh, 0.02)
    corners = made.vertices[made.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((normal * corners.mean(1)).sum(1) > 0).all()
    assert topology(made)["volume"] == pytest.approx(topology(mesh)["volume"], rel=0.03)


def test_results_are_reproducible_and_independent_of_position():
    mesh = noisy(sphere(rounds=4), 0.002)
    first, again = within_tolerance(mesh, 0.01), within_tolerance(mesh, 0.01)
    assert np.array_equal(first.vertices, again.vertices) and np.array_equal(first.faces, again.faces)
    far = within_tolerance(replace(mesh, vertices=mesh.vertices + [1e4, -2e4, 3e3]), 0.01)
    assert off(replace(far, vertices=far.vertices - [1e4, -2e4, 3e3]), mesh.vertices).max() < 0.01 + 1e-9


def test_colours_and_quality_are_interpolated():
    mesh = sphere(rounds=5)
    share = (mesh.vertices + 1) / 2
    mesh = replace(mesh, colors=np.round(255 * share), quality=share[:, 0])
    made = within_tolerance(mesh, 0.004)
    assert np.abs(made.colors - 255 * (made.vertices + 1) / 2).max() < 3
    assert np.abs(made.quality - (made.vertices[:, 0] + 1) / 2).max() < 0.01


@pytest.mark.parametrize(
    ("corner", "tolerance", "match"),
    [
        ([[0, 1, 3]], [1, 1, 1], "corners are outside"),
        ([[0, 1, -1]], [1, 1, 1], "corners are outside"),
        ([[0, 1, 2]], [1, 1], "tolerance has shape"),
        ([[0, 1, 2]], [1, 0, 1], "positive"),
        ([[0, 1, 2]], [1, np.nan, 1], "positive"),
    ],
)
def test_invalid_arrays_are_refused(corner, tolerance, match):
    with pytest.raises(ValueError, match=match):
        surface_ops.simplify(np.array(corner), np.eye(3), np.array(tolerance, float))


@pytest.mark.parametrize("denoise", ["on", "off"])
def test_extraction_simplifies_within_its_predicted_error(solid, denoise):
    options = ExtractOptions(voxel_size=0.08, denoise=denoise)
    fine = load_mesh(extract_mesh(solid, options=options, quiet=True)["mesh"])
    stats = extract_mesh(solid, options=replace(options, tolerance="auto"), quiet=True)
    made = load_mesh(stats["mesh"])
    assert len(made.faces) < 0.7 * len(fine.faces) and made.quality is not None and made.colors is not None
    assert stats["options"]["tolerance"] == "auto"
    (step,) = stats["processing"]
    assert step["step"] == "simplify" and step["tolerance"] == "auto" and step["topology_kept"]
