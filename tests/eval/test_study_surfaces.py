"""The table of surfaces: a scene, its mesh and its row, and nothing that is there is done again."""

from __future__ import annotations

import json

from linprim_geo.eval.studies import surfaces


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


def test_rows_of_earlier_folders_lack_what_is_new():
    *_, line = surfaces.table([{"scene": "cad", "chamfer": 0.07, "manifold": None}]).splitlines()
    assert line.startswith("| cad | – | – | 0.07 | – |")


def test_references_go_with_captures(tmp_path, capsys):
    assert surfaces.main(["-o", str(tmp_path), "--data", str(tmp_path), "--scenes"]) == 1
    assert "0 references go with 1 captures" in capsys.readouterr().err
