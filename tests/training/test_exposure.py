"""Exposure: gains of photographs are found, keep their mean, are resumed bit for bit, and are used in scores."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from linprim_geo.base.options import TrainOptions
from linprim_geo.capture.load import load_scene
from linprim_geo.points.photo_evidence import observe
from linprim_geo.synthetic.synth import synthesize
from linprim_geo.training.step.exposure import Exposure, best_gain, exposed, with_best_gain
from linprim_geo.training.train import train

QUICK = TrainOptions(
    iterations=60, max_primitives=300, initial_primitives=300, sh_degree=0, threads=1, exposure="gain", evaluate_every=0
)


@pytest.fixture(scope="module")
def drifting(tmp_path_factory):
    out = tmp_path_factory.mktemp("drift") / "scene"
    synthesize(
        out,
        shape="smooth",
        views=12,
        test_views=2,
        size=64,
        points=1500,
        supersample=1,
        exposure_drift=0.3,
        background="0.4,0.4,0.4",
    )
    return out


@pytest.fixture(autouse=True)
def own_points(monkeypatch):
    """Use only the scene's points as start points; finding more is slow and irrelevant here."""
    monkeypatch.setattr("linprim_geo.points.start_points.fill_gaps", lambda scene, *_: scene.points)


def true_gains(scene):
    return np.array(json.loads((scene / "synth.json").read_text())["gains"])


def test_synthetic_photographs_contain_their_gains(drifting):
    """Each photograph shows its gain times the colour of the uniform background."""
    gains = true_gains(drifting)
    assert np.abs(np.log(gains).mean(0)).max() < 1e-12 and np.log(gains).std() > 0.1
    for index in (0, 7):
        corner = load_scene(drifting).train[index].load().rgb[0, 0] / 255
        assert np.abs(corner - np.minimum(0.4 * gains[index], 1)).max() < 0.003
    assert np.abs(load_scene(drifting).test[0].load().rgb[0, 0] / 255 - 0.4).max() < 0.003


def test_gains_are_estimated_from_points(drifting):
    found, error = observe(load_scene(drifting)).log_gains
    assert np.abs(np.exp(found) / true_gains(drifting) - 1).max() < 0.06
    assert np.abs(found.mean(0)).max() < 1e-9 and np.isfinite(error).all()


def test_training_finds_the_gains_and_keeps_their_mean(drifting, tmp_path):
    result = train(drifting, tmp_path / "run", options=replace(QUICK, iterations=300), quiet=True)
    state = json.loads((tmp_path / "run" / "run.json").read_text())
    gains = np.array([state["gains"][view.name] for view in load_scene(drifting).train])
    assert np.abs(gains / true_gains(drifting) - 1).mean() < 0.03
    assert np.abs(np.log(gains).mean(0)).max() < 1e-5
    without = train(drifting, tmp_path / "off", options=replace(QUICK, iterations=300, exposure="none"), quiet=True)
    assert result["psnr"] > without["psnr"] + 0.5
    assert result["psnr_gain"] >= result["psnr"] - 0.05 and "psnr_gain" not in without
    # Training views are measured with their gains, as steps see them; the last line is of the last steps.
    last = json.loads((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()[-1])
    assert abs(result["train_psnr"] - last["train_psnr"]) < 3 and result["train_psnr"] > without["train_psnr"] + 3
    assert "gains" not in json.loads((tmp_path / "off" / "run.json").read_text())


def test_a_resumed_run_repeats_the_gains_bit_for_bit(drifting, tmp_path, monkeypatch):
    from linprim_geo.training.step.trainer import Trainer

    options = replace(QUICK, checkpoint_every=25)
    train(drifting, tmp_path / "whole", options=options, quiet=True)
    advance = Trainer.advance

    def killed(self):
        if self.step == 40:
            raise RuntimeError("killed")
        return advance(self)

    monkeypatch.setattr(Trainer, "advance", killed)
    with pytest.raises(RuntimeError):
        train(drifting, tmp_path / "torn", options=options, quiet=True)
    monkeypatch.setattr(Trainer, "advance", advance)
    train(drifting, tmp_path / "torn", resume=True, quiet=True)
    one, other = (torch.load(tmp_path / name / "checkpoints" / "step_000060.pt") for name in ("whole", "torn"))
    assert one["exposure"]["log_gain"].abs().max() > 0.05
    for table in ("exposure", "parameters"):
        assert one[table].keys() == other[table].keys()
        for name in one[table]:
            assert one[table][name].numpy().tobytes() == other[table][name].numpy().tobytes(), name


def test_an_update_moves_one_gain_and_keeps_the_mean():
    exposure = Exposure(4, np.log([[1.0] * 3, [2.0] * 3, [0.5] * 3, [1.0] * 3]))
    before = exposure.log_gain.clone()
    assert torch.equal(before.mean(0), torch.zeros(3))
    exposure.update(2, torch.tensor([1.0, -1.0, 0.0]), 0.0)
    moved = exposure.log_gain - before
    assert exposure.log_gain.mean(0).abs().max() < 1e-7
    assert moved[2, 0] < 0 < moved[2, 1] and moved[2, 2] == 0
    assert torch.allclose(moved[[0, 1, 3]], -moved[2] / 3, atol=1e-7)
    assert exposure.steps.tolist() == [0, 0, 1, 0]


def test_background_has_no_gain_and_clipped_white_stays():
    rgb, behind = torch.full((3, 2, 2), 0.6), torch.full((3, 2, 2), 0.2)
    target = torch.full((3, 2, 2), 0.5)
    target[:, 0, 0] = 1.0
    shown = exposed(rgb, torch.log(torch.tensor([2.0, 1.0, 3.0])), target, behind)
    assert torch.allclose(shown[:, 1, 1], torch.tensor([1.0, 0.6, 1.4]))  # (0.6 - 0.2) gain + 0.2
    assert torch.allclose(shown[:, 0, 0], torch.tensor([1.0, 0.6, 1.0]))
    log_gain = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    image = torch.rand(3, 2, 2, dtype=torch.float64, requires_grad=True)
    arguments = (image, log_gain, target.double() * 0.9, behind.double())
    assert torch.autograd.gradcheck(exposed, arguments)


def test_best_gain_is_the_least_squares_solution():
    rng = np.random.default_rng(0)
    render = rng.uniform(0.2, 0.8, (6, 5, 3))
    photo = render * [0.8, 1.1, 1.3]
    assert np.allclose(best_gain(render, photo), [0.8, 1.1, 1.3])
    assert np.allclose(best_gain(np.zeros((2, 2, 3)), np.ones((2, 2, 3))), 1)
    alpha = np.zeros((6, 5))
    alpha[:3] = 1
    shown = with_best_gain(render, photo, alpha)
    assert np.allclose(shown[:3], photo[:3]) and np.array_equal(shown[3:], render[3:])
