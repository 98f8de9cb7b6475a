"""Alignment of meshes to their reference, and its report."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.surfaces import camera_above, join, rotation, wavy
from scipy.spatial.transform import Rotation

from linprim_geo.cli import main as cli
from linprim_geo.eval.align import Motion, align
from linprim_geo.eval.mesh import eval_mesh_files
from linprim_geo.eval.surface_samples import refine, sample_surface
from linprim_geo.geometry.mesh import Mesh, select_faces
from linprim_geo.geometry.mesh_files import save_mesh

SMALL_TURN = Rotation.from_rotvec([0.05, -0.08, 0.06]).as_matrix()


def shape() -> Mesh:
    """An asymmetric surface: waves, and a thin wall on one side."""
    wall = wavy()
    wall = replace(wall, vertices=wall.vertices @ np.diag([0.4, 0.5, 1.0]) @ rotation(3).T + [0.2, 0.7, 0.3])
    return join(wavy(), wall)


def matrix_of(scale: float, turn: np.ndarray, offset) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = scale * turn, offset
    return matrix


def moved(mesh: Mesh, matrix: np.ndarray) -> Mesh:
    return replace(mesh, vertices=mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3])


@pytest.mark.parametrize(
    ("way", "scale", "turn", "offset"),
    [
        ("icp", 1.0, SMALL_TURN, (0.05, -0.03, 0.04)),
        ("similarity", 1.3, SMALL_TURN, (0.05, -0.03, 0.04)),
        ("similarity", 0.013, rotation(5), (700.0, -20.0, 3.0)),
    ],
)
def test_alignment_inverts_a_known_motion(way, scale, turn, offset):
    mesh, motion = shape(), matrix_of(scale, turn, offset)
    _, about = align(moved(mesh, motion), mesh, way)
    # Surfaces are equal up to rounding of coordinates of 700, with a scale of 0.013.
    np.testing.assert_allclose(np.array(about["matrix"]) @ motion, np.eye(4), atol=1e-7)
    assert about["way"] == way and about["scale"] == pytest.approx(1 / scale)
    assert about["distance_after"] < 1e-7 < about["distance_before"]


def test_parts_missing_in_one_mesh_do_not_change_the_alignment():
    mesh, motion = shape(), matrix_of(1.0, SMALL_TURN, (0.02, 0.0, -0.03))
    part = select_faces(mesh, mesh.vertices[mesh.faces].mean(1)[:, 0] > 0.15)
    _, about = align(moved(part, motion), mesh, "icp")
    np.testing.assert_allclose(np.array(about["matrix"]) @ motion, np.eye(4), atol=1e-6)


def test_alignment_to_points_of_a_scan():
    mesh, motion = shape(), matrix_of(1.1, SMALL_TURN, (0.02, 0.05, -0.03))
    points, _ = sample_surface(refine(mesh, 0.1), 100_000, 1)
    _, about = align(moved(mesh, motion), points, "similarity")
    # Points are about 0.005 apart; averaging over all of them is much more accurate.
    np.testing.assert_allclose(np.array(about["matrix"]) @ motion, np.eye(4), atol=1e-3)


def test_an_aligned_mesh_stays():
    _, about = align(shape(), shape(), "icp")
    np.testing.assert_allclose(about["matrix"], np.eye(4), atol=1e-9)


def test_cameras_of_the_run_are_transformed_with_the_mesh(tmp_path):
    mesh, motion = shape(), matrix_of(0.5, rotation(2), (3.0, 1.0, 2.0))
    save_mesh(tmp_path / "mesh.ply", moved(mesh, motion))
    save_mesh(tmp_path / "reference.ply", mesh)
    camera = camera_above(4.0, focal=120.0, target=(1.0, 0.5))
    turned = Motion(0.5, rotation(2), np.array([3.0, 1.0, 2.0])).moved(camera)
    scores = {}
    for name, seen_by, way in (("reference", camera, "none"), ("mesh", turned, "similarity")):
        scene = SimpleNamespace(train=(SimpleNamespace(camera=seen_by),), unit="unit")
        run = SimpleNamespace(path=tmp_path / "run", scene=lambda scene=scene: scene)
        files = tmp_path / f"{name}.ply", tmp_path / "reference.ply"
        scores[name] = eval_mesh_files(*files, samples=2000, run=run, align=way)
    kept = [scores[name]["visible"]["kept_prediction"] for name in ("reference", "mesh")]
    # Samples differ only by rounding to float32 in the file.
    assert 0.1 < kept[0] < 0.95 and kept[1] == pytest.approx(kept[0], abs=0.01)
    assert scores["mesh"]["chamfer"] < 1e-5


def test_the_command_reports_the_alignment(tmp_path, capsys):
    mesh = shape()
    save_mesh(tmp_path / "a.ply", moved(mesh, matrix_of(1.0, SMALL_TURN, (0.05, 0.0, 0.0))))
    save_mesh(tmp_path / "b.ply", mesh)
    words = ["eval-mesh", str(tmp_path / "a.ply"), str(tmp_path / "b.ply"), "--samples", "2000", "--json"]
    assert cli.main(words) == 0
    plain = json.loads(capsys.readouterr().out)
    assert plain["align"] == {"way": "none"} and plain["chamfer"] > 0.01
    assert cli.main([*words, "--align", "icp"]) == 0
    shown = capsys.readouterr()
    aligned = json.loads(shown.out)
    assert aligned["chamfer"] < 1e-5 and aligned["align"]["scale"] == 1
    assert shown.err.startswith("linprim-geo: aligned by icp: scaled by 1, turned by 6.4")
