"""Whole trainings agree with recorded_trainings.json. After an intended change record them again
(`eval/studies/recorded_trainings.py`) and report the difference."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from linprim_geo.eval.studies.recorded_trainings import DRIFT, band, measure, read_rows

RECORDED = read_rows(Path(__file__).with_name("recorded_trainings.json"))
# A step may take so many times the median of those recorded, as a ratio to the core's limit: the slowest of these, on a
# busy machine, took 1.4 times the fastest.
SLOWER = 1.5


@pytest.mark.slow
@pytest.mark.parametrize("scene", DRIFT)
def test_a_training_agrees_with_the_record(scene, tmp_path):
    rows = [row for row in RECORDED if row["scene"] == scene]
    found = measure(scene, 0, tmp_path)
    assert all(row["effects"] == found["effects"] for row in rows)
    for name in ("psnr", "chamfer", "angle"):
        low, high = band([row[name] for row in rows])
        assert low < found[name] < high, name
    alike = [row for row in rows if row["instruction_set"] == found["instruction_set"]]
    if not alike:
        pytest.skip(f"no step of {found['instruction_set']} is recorded")
    assert found["step_over_limit"] < SLOWER * np.median([row["step_over_limit"] for row in alike])
