"""The table of effects: when a decision counts as right."""

from __future__ import annotations

import pytest

from linprim_geo.base.files import write_json
from linprim_geo.eval.studies import effects

SPREAD, SEEDS = {"psnr": 0.1, "depth": 0.05}, 8
"""With eight seeds a change counts from 0.1 dB and 0.05 % upwards."""


def row(psnr, depth, called_for, decided_on, reason="data"):
    return {
        "reason": reason,
        "judged_by": "psnr",
        "gain": {"psnr": psnr, "depth": depth},
        "called_for": called_for,
        "decided_on": decided_on,
    }


@pytest.mark.parametrize(
    ("psnr", "depth", "called_for", "decided_on", "expected"),
    [
        (0.5, 0.0, True, True, "right: gains"),
        (0.05, 0.0, True, True, "gain not shown"),
        (-0.5, 0.0, True, True, "wrong: loses"),
        (0.5, 0.0, True, False, "wrong: gains"),
        (0.05, 0.0, False, False, "right: no change"),
        (-0.5, 0.0, False, False, "right: loses"),
        (0.5, 0.0, False, False, "wrong: gains"),
        (0.5, -0.2, False, False, "wrong: gains"),  # 10 and 8 standard errors
        (0.5, -7.0, False, False, "right: loses more than it gains"),
        (0.5, -7.0, False, True, "wrong: loses more than it gains"),
        (0.5, -7.0, True, True, "right: gains"),
    ],
)
def test_verdicts_follow_gains_and_decisions(psnr, depth, called_for, decided_on, expected):
    assert effects.verdict(row(psnr, depth, called_for, decided_on), SPREAD, SEEDS) == expected


def test_verdicts_of_kept_requested_and_impossible_effects():
    assert effects.verdict(row(0.0, 0.0, False, True, "kept"), SPREAD, SEEDS) == "right: no change, kept"
    assert effects.verdict(row(-0.5, 0.0, False, True, "kept"), SPREAD, SEEDS) == "wrong: loses, kept"
    assert effects.verdict(row(0.5, 0.0, False, False, "request"), SPREAD, SEEDS) == "gains, on request"
    assert effects.verdict(row(0.5, 0.0, False, False, "impossible"), SPREAD, SEEDS) == "ruled out"
    assert effects.verdict(row(0.5, 0.0, True, True), {"psnr": None, "depth": None}, 1) == "–"


def test_pixels_without_a_surface_count_as_wholly_wrong(tmp_path, monkeypatch):
    write_json(tmp_path / "reference.ply", {})
    monkeypatch.setattr(effects, "train", lambda *_, **__: {"psnr": 30.0})
    monkeypatch.setattr(effects, "psnr_with_gains", lambda _: 31.0)
    monkeypatch.setattr(effects, "eval_depth_run", lambda *_: {"coverage": 0.9, "abs_rel": 0.02})
    monkeypatch.setattr(effects, "write_json", lambda *_: None)
    options = effects.base_options(effects.Size(32, 10, 50))
    found = effects.trained(tmp_path, tmp_path, "base", effects.Choice("none"), options)
    assert found["psnr"] == 30.0 and found["psnr_with_gains"] == 31.0 and found["depth"] == pytest.approx(0.9 * 2 + 10)
