"""Advice for trainings whose held-out views score much lower than training views."""

from __future__ import annotations

import pytest

from linprim_geo.base.options import TrainOptions
from linprim_geo.training.held_out_gap import FEW_VIEWS, LARGEST_GAP, gap_advice

FAR = {"name": "environment", "value": 30.0, "threshold": 10.0}
DRIFT = {"name": "exposure", "value": 9.0, "threshold": 3.0}
NEITHER = {"name": "environment", "value": None, "threshold": 10.0}


def test_no_advice_up_to_the_limit():
    assert gap_advice(30.0, 30.0 - LARGEST_GAP, 50, TrainOptions(), [FAR]) is None
    assert gap_advice(20.0, 30.0, 5, TrainOptions(), []) is None
    assert gap_advice(float("nan"), 10.0, 50, TrainOptions(), []) is None


@pytest.mark.parametrize(
    "decisions, options, views, named",
    [
        ([DRIFT, FAR], TrainOptions(), 50, "--exposure gain"),
        ([FAR, DRIFT], TrainOptions(background="random"), 50, "--background environment"),
        ([FAR], TrainOptions(background="environment"), 50, "poses that are off"),
        ([DRIFT], TrainOptions(exposure="gain"), FEW_VIEWS - 1, f"{FEW_VIEWS - 1} photographs"),
        ([NEITHER, {}], TrainOptions(), FEW_VIEWS, "poses that are off"),
    ],
)
def test_advice_names_the_cause_with_evidence(decisions, options, views, named):
    advice = gap_advice(29.0, 15.3, views, options, decisions)
    assert advice.startswith("held-out views are 13.7 dB behind training views: ") and named in advice
