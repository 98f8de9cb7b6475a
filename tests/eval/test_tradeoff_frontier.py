"""Evaluation of a sweep: the frontier, worthwhile steps, sentences, and panels with few points."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree

import numpy as np

from linprim_geo.eval.tradeoff import page as tradeoff_page
from linprim_geo.eval.tradeoff.frontier import frontier, pays, verdict
from linprim_geo.eval.tradeoff.parameters import Parameter, Value
from linprim_geo.imaging.plots import frontiers


def row(value, seconds, error, name="depth_percent", spread=0.0, rounds=3):
    low, high = seconds * (1 - spread), seconds * (1 + spread)
    return {
        "value": value,
        "seconds": seconds,
        "low": low,
        "high": high,
        "rounds": rounds,
        "default": False,
        name: error,
    }


def parameter(*names, error="depth_percent"):
    return Parameter("rays", "ray model", "render", tuple(Value(name) for name in names), names[0], (error,))


def test_the_frontier_of_known_points():
    points = [
        (1.0, 5.0),
        (2.0, 3.0),
        (2.5, 3.0),
        (3.0, 4.0),
        (4.0, 1.0),
        (0.5, 9.0),
        (4.0, 2.0),
        (math.nan, 0.0),
        (9.0, math.nan),
    ]
    assert frontier(points) == [5, 0, 1, 4]
    assert frontier([(1.0, 1.0), (1.0, 1.0)]) == [0] and frontier([]) == []
    rng = np.random.default_rng(0)
    points = [tuple(p) for p in rng.integers(1, 9, (60, 2)).astype(float)]
    on = frontier(points)
    for k, (t, e) in enumerate(points):
        beaten = any(a <= t and b <= e and (a, b) != (t, e) for a, b in points)
        assert (not beaten) == ((t, e) in [points[i] for i in on]), k


def test_a_step_pays_if_the_error_falls_with_the_root_of_the_time():
    assert pays(row("a", 1.0, 1.0), row("b", 4.0, 0.5), "depth_percent")
    assert not pays(row("a", 1.0, 1.0), row("b", 4.0, 0.51), "depth_percent")
    assert not pays(row("a", 1.0, 1.0), row("b", 1.0, 0.995), "depth_percent")  # less than 1 % is nothing
    assert pays(
        row("a", 1.0, 1.0, spread=0.2), row("b", 1.3, 0.95, spread=0.2), "depth_percent"
    )  # equal within the spread
    assert not pays(row("a", 1.0, 1.0, spread=0.01), row("b", 1.3, 0.95, spread=0.01), "depth_percent")
    assert pays(row("a", 1.0, 1.0), row("b", 99.0, 0.0), "depth_percent")


def test_verdict_sentences_follow_the_rule():
    said = verdict(parameter("affine", "exact"), [row("affine", 1.0, 1.0), row("exact", 1.18, 0.8)])
    assert said["sentence"] == (
        "Ray model: exact costs 1.18x the time of affine and removes 20 % of the depth error (1 to 0.8 %): worth it."
    )
    assert (said["cheapest"], said["taken"], said["most_accurate"]) == ("affine", "exact", "exact")
    said = verdict(parameter("a", "b"), [row("a", 1.0, 1.0), row("b", 4.0, 0.9)])
    assert said["sentence"].endswith(
        "b costs 4.00x the time of a and removes 10 % of the depth error (1 to 0.9 %): not worth it."
    )
    said = verdict(parameter("a", "b", "c"), [row("a", 1.0, 1.0), row("b", 1.5, 0.5), row("c", 9.0, 0.45)])
    assert "worth it; c would cost 6.00x the time of b and remove 10 %" in said["sentence"] and said["taken"] == "b"
    said = verdict(parameter("a", "b", "c"), [row("a", 1.0, 1.0), row("b", 2.0, 0.9), row("c", 3.0, 0.1)])
    assert said["taken"] == "c"  # a step that does not pay is no obstacle to the next one
    said = verdict(parameter("a", "b"), [row("a", 1.0, 0.5), row("b", 4.0, 0.9)])
    assert "a is the fastest, and no other removes any of the depth error (b costs 4.00x)" in said["sentence"]
    said = verdict(parameter("a", "b"), [row("a", 1.0, 1.0, spread=0.3), row("b", 1.2, 0.9, spread=0.3)])
    assert "1.20x (within the spread of the timings)" in said["sentence"] and said["taken"] == "b"
    assert verdict(parameter("a", "b"), [row("a", 1.0, math.nan), row("b", 2.0, math.nan)])["error"] is None
    assert verdict(parameter("a", "b"), [])["error"] is None


def test_errors_missing_in_some_rows_do_not_decide():
    each = Parameter("x", "x", "train", (Value("a"), Value("b")), "a", ("chamfer_percent", "photo_percent"))
    rows = [row("a", 1.0, math.nan, "chamfer_percent"), row("b", 2.0, 1.0, "chamfer_percent")]
    rows[0]["photo_percent"], rows[1]["photo_percent"] = 2.0, 1.0
    assert verdict(each, rows)["error"] == "photo_percent"


def test_zero_errors_and_single_points_can_be_plotted():
    for rows in ([row("a", 1.0, 0.0)], [row("a", 1.0, 0.0), row("b", 1e-6, 3.0)]):
        panel = tradeoff_page.panel([each | {"frontier": True} for each in rows], "depth_percent")
        assert [point.name for point in panel.points] == [each["value"] for each in rows]
        assert panel.y_label == "depth error, %" and ElementTree.fromstring(frontiers([panel], "errors")) is not None
