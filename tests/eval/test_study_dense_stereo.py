"""The study of dense stereo: its logistic fit and its tables."""

from __future__ import annotations

import numpy as np

from linprim_geo.eval.studies.dense_stereo import fit, reliability, report, row
from linprim_geo.stereo.confidence import WEIGHTS, probability


def capture(weights: np.ndarray, count: int, seed: int) -> dict:
    """Synthetic measurements of a capture that follow the model with these weights."""
    rng = np.random.default_rng(seed)
    found = rng.uniform(size=(count, len(weights)))
    found[:, 0] = 1
    right = rng.uniform(size=count) < 1 / (1 + np.exp(-found @ weights))
    return {
        "evidence": found,
        "error": np.where(right, 0.001, 0.5),
        "photographs": np.array(3),
        "size": np.array("8x6"),
        "coverage": np.array(0.5),
        "core_seconds": np.array(np.nan),
    }


def test_the_fit_recovers_the_weights_of_synthetic_data():
    weights = np.array([-0.5, 0.4, 1.5, -2.0, 0.5, 1.0])
    captures = [capture(weights, 40_000, 1), capture(weights, 60_000, 2)]
    found = np.concatenate([each["evidence"] for each in captures])
    predicted = 1 / (1 + np.exp(-found @ weights))
    information = (found * (predicted * (1 - predicted))[:, None]).T @ found
    # Both count the same, which makes the variance larger by 1.04.
    error = np.sqrt(np.diag(np.linalg.inv(information)) * 1.04)
    assert (np.abs(fit(captures) - weights) < 4 * error).all()


def test_reliability_of_a_calibrated_model_is_diagonal():
    one = capture(WEIGHTS, 50_000, 3)
    rows = reliability([one])
    assert abs(sum(each["share"] for each in rows) - 1) < 1e-6
    for each in rows:
        assert each["off"] < 4 * np.sqrt(0.25 / (each["share"] * 50_000))
    figures = row("one", one)
    assert figures["within_1"] == (one["error"] < 0.01).mean()
    assert abs(figures["predicted"] - probability(one["evidence"]).mean()) < 1e-6
    text = report({"one": one, "two": one}, ["two"])
    assert "Fitted (two)" in text and "Not fitted (one)" in text and "| – |" in text
