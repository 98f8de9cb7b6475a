"""Dropout of primitives: selection, expected values, and when it is used."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.synthetic.synth import synthesize
from linprim_geo.training.step.dropout import FEW_PHOTOGRAPHS, SHARE, TOGETHER, along_curve, chosen_share, with_dropout
from linprim_geo.training.train import train


def active_of(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    center = torch.rand(count, 3, generator=generator)
    density = (1 + torch.rand(count, generator=generator)).requires_grad_()
    return center, torch.zeros(count, 4), torch.ones(count, 3), density, torch.zeros(count, 1, 3)


def test_dropout_keeps_the_expected_density_and_other_tensors():
    active = active_of(500)
    total, left_out = torch.zeros(500), 0
    for step in range(400):
        *rest, colors = with_dropout(active, 0.2, 3, step)
        density = rest.pop()
        assert all(a is b for a, b in zip([*rest, colors], [*active[:3], active[4]], strict=True))
        total += (density / active[3]).detach()
        left_out += int((density == 0).sum())
    # Shares of 400 steps have a standard error of 0.02, and 0.025 of a density once it is divided by 0.8.
    np.testing.assert_allclose(total / 400, 1.0, atol=0.13)
    assert left_out / (400 * 500) == pytest.approx(0.2, abs=0.01)


def test_runs_of_neighbours_are_dropped_together():
    active = active_of(3000)
    out = (with_dropout(active, 0.2, 0, 7)[3] == 0).numpy()[along_curve(active[0].numpy())]
    edges = np.flatnonzero(np.diff(out.astype(int)))
    assert (np.diff(edges) % TOGETHER == 0).all() and 0.1 < out.mean() < 0.3


def test_the_curve_orders_neighbours_next_to_each_other():
    points = np.random.default_rng(0).random((4096, 3))
    steps = np.linalg.norm(np.diff(points[along_curve(points)], axis=0), axis=1)
    # The mean distance of nearest neighbours is 0.035, that of random pairs 0.66.
    assert np.median(steps) < 0.08
    assert sorted(along_curve(points)) == list(range(4096))
    line = np.array([[0.0, 0, 0]] * 5)
    assert along_curve(line).tolist() == [0, 1, 2, 3, 4]


def test_dropout_depends_only_on_seed_and_step():
    active = active_of(200)
    first = with_dropout(active, 0.3, 1, 5)[3]
    assert torch.equal(first, with_dropout(active, 0.3, 1, 5)[3])
    assert not torch.equal(first, with_dropout(active, 0.3, 1, 6)[3])
    assert not torch.equal(first, with_dropout(active, 0.3, 2, 5)[3])


def test_dropped_primitives_have_no_gradient():
    active = active_of(200)
    density = with_dropout(active, 0.25, 0, 0)[3]
    (gradient,) = torch.autograd.grad(density.sum(), active[3])
    np.testing.assert_allclose(gradient, np.where(density.detach() == 0, 0, 1 / 0.75), rtol=1e-6)


def test_auto_dropout_is_on_for_few_photographs():
    assert chosen_share("auto", FEW_PHOTOGRAPHS) == SHARE and chosen_share("auto", FEW_PHOTOGRAPHS + 1) == 0
    assert chosen_share(0.1, 100) == 0.1 and chosen_share(0.0, 3) == 0


@pytest.mark.parametrize(("views", "share"), [(FEW_PHOTOGRAPHS, SHARE), (FEW_PHOTOGRAPHS + 1, 0.0)])
def test_a_run_records_the_chosen_dropout(tmp_path, views, share):
    synthesize(tmp_path / "ball", shape="smooth", views=views, test_views=2, size=(32, 32), points=200)
    options = TrainOptions(iterations=20, max_primitives=200, evaluate_every=0, threads=1)
    train(tmp_path / "ball", tmp_path / "auto", SceneOptions(), options, quiet=True)
    assert json.loads((tmp_path / "auto" / "config.json").read_text())["train_options"]["dropout"] == share
    train(tmp_path / "ball", tmp_path / "given", SceneOptions(), replace(options, dropout=share), quiet=True)
    frames = [(tmp_path / name / "training_frame.npz").read_bytes() for name in ("auto", "given")]
    assert frames[0] == frames[1]
    train(tmp_path / "ball", tmp_path / "other", SceneOptions(), replace(options, dropout=0.5), quiet=True)
    assert (tmp_path / "other" / "training_frame.npz").read_bytes() != frames[0]
