"""The table of surfaces: meshes and rows of scenes, computed only once."""

from __future__ import annotations

import json
from dataclasses import replace

from linprim_geo.capture.load import load_scene
from linprim_geo.eval.studies import surfaces
from linprim_geo.geometry.mesh_files import load_mesh
from linprim_geo.runs.run import Run
from linprim_geo.synthetic.synth import synthesize


def test_a_scene_is_trained_meshed_and_scored_once(tmp_path, monkeypatch, capsys):
    command = ["-o", str(tmp_path), "--scenes", "smooth", "--size", "48", "--iterations", "40"]
    command += ["--max-primitives", "300", "--primitives", "octahedron", "--methods", "tsdf"]
    assert surfaces.main(command) == 0
    (row,) = json.loads((tmp_path / "surfaces.json").read_text())["rows"]
    assert (row["scene"], row["primitive"], row["method"]) == ("smooth", "octahedron", "tsdf")
    assert 0 < row["median"] < row["chamfer"] < 20 and 0 < row["f1"] <= 1
    assert row["train_cpu_seconds"] > 0 and row["cpu_seconds"] > 0
    table = (tmp_path / "surfaces.md").read_text().splitlines()
    assert any(line.startswith("| smooth | octahedron | tsdf | ") for line in table)

    def fail(*_, **__):
        raise AssertionError("it is there already")

    monkeypatch.setattr("linprim_geo.training.train.train", fail)
    monkeypatch.setattr(surfaces, "score", fail)
    assert surfaces.main(command) == 0
    assert json.loads((tmp_path / "surfaces.json").read_text())["rows"] == [row]
    # What fusing exact depth maps makes of it is far better than what 40 steps of training do.
    assert surfaces.main([*command, "--true-depth"]) == 0
    exact, again = json.loads((tmp_path / "surfaces.json").read_text())["rows"]
    assert again == row and exact["method"] == "true depth" and exact["faces"] > 0
    assert exact["chamfer"] < 0.3 * row["chamfer"] and exact["f1"] > 0.95
    # The bound in % of the diagonal: maps of 48 pixels.
    assert exact["chamfer"] < 0.5


def test_captures_without_a_reference_are_scored_by_images_and_depths(tmp_path):
    synthesize(tmp_path / "ball", shape="smooth", views=6, test_views=2, size=(48, 48), points=200)
    command = ["-o", str(tmp_path / "out"), "--scenes", "--data", str(tmp_path / "ball"), "--references", "none"]
    command += ["--iterations", "40", "--max-primitives", "300", "--primitives", "octahedron", "--methods", "tsdf"]
    assert surfaces.main([*command, "--stereo", "auto", "off"]) == 0
    rows = json.loads((tmp_path / "out" / "surfaces.json").read_text())["rows"]
    assert [row["stereo"] for row in rows] == ["auto", "off"]
    for row in rows:
        assert row["psnr"] > 5 and 0 <= row["depth_right"] <= 1 and "chamfer" not in row
    options = Run.open(tmp_path / "out" / "ball_octahedron_without_stereo").train_options
    assert options.start == "points" and options.stereo_depth == 0


def test_depth_right_of_exact_and_enlarged_meshes(tmp_path):
    synthesize(tmp_path / "ball", shape="smooth", views=6, test_views=2, size=(48, 48), points=200, depth_format="npy")
    views = load_scene(tmp_path / "ball").train
    mesh = load_mesh(tmp_path / "ball" / "reference.ply")
    assert surfaces.depth_right(mesh, views) > 0.98
    # Nearer to the cameras by several times the tolerance, but at outlines.
    larger = replace(mesh, vertices=1.2 * mesh.vertices)
    assert surfaces.depth_right(larger, views) < 0.2
    assert surfaces.depth_right(mesh, [replace(view, depth_path=None) for view in views]) is None


def test_tables_show_missing_columns_of_old_rows():
    *_, line = surfaces.table([{"scene": "cad", "chamfer": 0.07, "manifold": None}]).splitlines()
    assert line.startswith("| cad | – | – | – | – | – | 0.07 | – |")


def test_captures_without_references_option_are_refused(tmp_path, capsys):
    assert surfaces.main(["-o", str(tmp_path), "--data", str(tmp_path), "--scenes"]) == 1
    assert "0 references go with 1 captures" in capsys.readouterr().err
