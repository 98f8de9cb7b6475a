"""Evaluation of recorded trainings, which tests/training/test_recorded_trainings.py runs."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from linprim_geo.base.errors import LinprimError
from linprim_geo.eval.studies import recorded_trainings
from linprim_geo.eval.studies.recorded_trainings import StepTiming, add_row, band, read_rows
from linprim_geo.kernels import ops


def test_the_band_has_the_stated_rate_of_false_alarms(monkeypatch):
    monkeypatch.setattr(recorded_trainings, "FALSE_ALARMS", 0.1)
    rng, outside, trials = np.random.default_rng(1), 0, 4000
    for _ in range(trials):
        *values, more = rng.normal(30.0, 0.2, 6)
        low, high = band(values)
        outside += not low < more < high
    # Four standard deviations of a share of 0.1 in so many trials.
    assert abs(outside / trials - 0.1) < 4 * np.sqrt(0.1 * 0.9 / trials)


def test_two_values_are_too_few_for_a_band():
    with pytest.raises(LinprimError, match="2 values tell nothing"):
        band([1.0, 2.0])


def test_rows_of_the_same_training_are_replaced(tmp_path):
    path = tmp_path / "rows.json"
    for scene, instruction_set, seed, psnr in (
        ("room", "v3", 0, 1.0),
        ("cad", "v4", 0, 2.0),
        ("cad", "v3", 1, 3.0),
        ("cad", "v3", 0, 4.0),
        ("cad", "v3", 1, 5.0),
    ):
        add_row(path, {"scene": scene, "instruction_set": instruction_set, "seed": seed, "psnr": psnr})
    assert [row["psnr"] for row in read_rows(path)] == [4.0, 5.0, 2.0, 1.0]


def test_a_file_without_rows_is_refused(tmp_path):
    path = tmp_path / "rows.json"
    path.write_text('{"scene": "cad"}')
    with pytest.raises(LinprimError, match=r"rows\.json: holds no list, wanted rows"):
        read_rows(path)


def test_steps_are_timed_relative_to_the_machine_limit(monkeypatch):
    """Some of the last steps are timed. An undisturbed step takes 3 s and its pairs 2 s at the limit, so the ratio is
    1.5, although most steps are disturbed."""
    clock, seconds = [0.0], iter([3.0, 3.0, *[9.0] * 8])
    trainer = SimpleNamespace(step=recorded_trainings.TIMED_FROM - 50)

    def advance():
        timed = trainer.step >= recorded_trainings.TIMED_FROM and trainer.step % recorded_trainings.TIMED_EVERY == 0
        clock[0] += next(seconds) if timed else 100.0
        trainer.step += 1

    trainer.advance = advance
    monkeypatch.setattr(recorded_trainings.time, "process_time", lambda: clock[0])
    monkeypatch.setattr(ops, "statistics", lambda: {"hit_lanes": 4e8})
    monkeypatch.setattr(ops, "machine_limits", lambda: {"pair_forward_ns": 2.0, "pair_backward_ns": 3.0})
    timing = StepTiming()
    for _ in range(100):
        timing.advance(trainer)
    assert len(timing.ratios) == 10 and timing.over_limit() == 1.5
