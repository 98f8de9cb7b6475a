"""The ladder of degradations: captures of all rungs, rows that are measured once, and ratios to ideal photographs."""

from __future__ import annotations

import json

import pytest

from linprim_geo.capture.load import load_scene
from linprim_geo.eval.studies import ladder
from linprim_geo.synthetic.synth import synthesize


def test_two_rungs_are_made_trained_and_scored_once(tmp_path, monkeypatch):
    monkeypatch.setattr(ladder, "VIEWS", 6)
    monkeypatch.setattr(ladder, "TEST_VIEWS", 2)
    command = ["-o", str(tmp_path), "--scenes", "smooth", "--rungs", ladder.MASKS, ladder.IDEAL]
    command += ["--size", "48", "--iterations", "40", "--max-primitives", "300"]
    assert ladder.main(command) == 0
    rows = json.loads((tmp_path / "ladder.json").read_text())
    assert [row["rung"] for row in rows] == [ladder.MASKS, ladder.IDEAL]
    for row in rows:
        assert row["chamfer"] > 0 and row["psnr"] > 5 and 0 <= row["far_off"] <= 1 and row["cpu_seconds"] > 0
    # Only the rung with masks has alpha.
    captures = [tmp_path / "captures" / name for name in ("smooth_masks_no_background_0", "smooth_ideal_0")]
    assert [load_scene(capture).has_alpha for capture in captures] == [True, False]

    def fail(*_, **__):
        raise AssertionError("it is there already")

    monkeypatch.setattr(ladder, "measured", fail)
    assert ladder.main(command) == 0
    assert json.loads((tmp_path / "ladder.json").read_text()) == rows


@pytest.mark.parametrize(("scene", "rung"), [("smooth", "motion blur 0.8 px"), ("room", "phone")])
def test_rungs_without_masks_can_be_synthesised(tmp_path, scene, rung):
    settings = ladder.settings_of(scene, rung) | {"views": 8, "test_views": 2, "points": 50, "supersample": 1}
    synthesize(tmp_path / "out", shape=scene, size=(96, 96), **settings)
    assert not load_scene(tmp_path / "out").has_alpha


def test_a_room_has_no_rung_with_masks():
    assert ladder.settings_of("room", ladder.MASKS) is None
    assert ladder.settings_of("cad", ladder.MASKS) == {}


def test_ratios_are_to_ideal_photographs_of_the_same_scene():
    rows = [
        {"scene": "cad", "rung": ladder.IDEAL, "chamfer": 0.5},
        {"scene": "cad", "rung": "phone", "chamfer": 1.0},
        {"scene": "room", "rung": "phone", "chamfer": 3.0},
    ]
    lines = ladder.table(rows).splitlines()[2:]
    assert lines[1].startswith("| cad | phone | – | 1 | 2 | ")
    assert lines[2].startswith("| room | phone | – | 3 | – | ")
