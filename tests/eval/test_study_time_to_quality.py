"""Time to quality: trainings of all variants, rows that are measured once, and differences to the first variant."""

from __future__ import annotations

import json

import pytest

from linprim_geo.eval.studies import time_to_quality
from linprim_geo.runs.run import Run
from linprim_geo.synthetic.synth import synthesize


def test_variants_are_trained_with_their_options_and_scored_once(tmp_path, monkeypatch):
    capture = tmp_path / "smooth"
    synthesize(capture, shape="smooth", views=6, test_views=2, size=(48, 48), points=300, supersample=1)
    monkeypatch.setattr(time_to_quality, "VARIANTS", {"default": {"iterations": 60}, "shorter": {"iterations": 30}})
    command = ["-o", str(tmp_path / "out"), "--data", str(capture), "--max-primitives", "300", "--mesh"]
    assert time_to_quality.main(command) == 0
    rows = json.loads((tmp_path / "out" / "time_to_quality.json").read_text())
    assert [row["variant"] for row in rows] == ["default", "shorter"]
    for row, steps in zip(rows, (60, 30), strict=True):
        run = Run.open(tmp_path / "out" / "runs" / f"smooth_{row['variant']}_0")
        assert run.train_options.iterations == steps
        assert row["psnr"] > 5 and row["chamfer"] > 0 and row["train_cpu_seconds"] > 0 and row["cpu_seconds"] > 0

    def fail(*_, **__):
        raise AssertionError("it is there already")

    monkeypatch.setattr(time_to_quality, "measured", fail)
    assert time_to_quality.main(command) == 0
    assert json.loads((tmp_path / "out" / "time_to_quality.json").read_text()) == rows


def test_medians_are_of_differences_to_the_first_variant_of_the_same_capture_and_seed():
    def row(capture: str, variant: str, psnr: float, seconds: float, **scores: float) -> dict:
        return {
            "capture": capture,
            "variant": variant,
            "seed": 0,
            "psnr": psnr,
            "train_cpu_seconds": seconds,
        } | scores

    rows = [
        row("room", "default", 30.0, 100.0, chamfer=0.2),
        row("room", "3,500 steps", 29.5, 50.0, chamfer=0.3),
        row("table", "default", 20.0, 200.0),
        row("table", "3,500 steps", 19.7, 80.0),
    ]
    lines = time_to_quality.table(rows).splitlines()
    assert lines[3] == "| room | 3,500 steps | 0 | 29.5 | 50 | 0.5 | 0.3 | – | – | – |"
    assert lines[-2:] == ["| default | 2 | 0 | 1 | 1 |", "| 3,500 steps | 2 | -0.4 | 0.45 | 1.5 |"]


def test_a_capture_that_is_not_there_is_one_sentence(tmp_path, capsys):
    assert time_to_quality.main(["-o", str(tmp_path / "out"), "--data", str(tmp_path / "none")]) == 1
    message = capsys.readouterr().err.strip()
    assert message.startswith("time_to_quality: ") and "\n" not in message and "none" in message


@pytest.mark.parametrize("name", list(time_to_quality.VARIANTS))
def test_variants_name_options_of_training(name):
    from linprim_geo.base.options import TrainOptions

    assert TrainOptions(**time_to_quality.VARIANTS[name])
