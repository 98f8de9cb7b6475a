"""Time budgets: plans in closed form, runs that keep their time and are reproducible, and errors."""

from __future__ import annotations

import json
import math
import time
from dataclasses import replace

import numpy as np
import pytest
from conftest import with_budget
from helpers.training_runs import assert_same_run

from linprim_geo.base import budget
from linprim_geo.base.budget import Budget
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import ExtractOptions, TrainOptions
from linprim_geo.cli import main as cli
from linprim_geo.cli.options import seconds
from linprim_geo.runs.run import Run
from linprim_geo.surface import voxel_budget
from linprim_geo.surface.extract import extract_mesh
from linprim_geo.surface.voxel_budget import VoxelCost, plan_voxel
from linprim_geo.training.budget import pacing
from linprim_geo.training.budget import plan as time_budget
from linprim_geo.training.budget.plan import (
    LARGEST_CORRECTION,
    LEAST_PRIMITIVES,
    LEAST_STEPS,
    STEPS_PER_PRIMITIVE,
    StepCost,
    corrected_steps,
    mean_population,
    plan_training,
)
from linprim_geo.training.loop import evaluate
from linprim_geo.training.start import start_trainer
from linprim_geo.training.step import coarse_images
from linprim_geo.training.step.trainer import Trainer
from linprim_geo.training.step.training_images import load_training_images
from linprim_geo.training.train import train

MANY = 10**9


# --- what is chosen --------------------------------------------------------------------------------------


def test_step_cost_is_a_line_through_both_calibrations():
    cost = StepCost.fit((100, 0.002), (500, 0.004))
    assert (cost.base, cost.per_primitive) == pytest.approx((0.0015, 5e-6))
    assert cost.seconds(1000) == pytest.approx(0.0065)
    assert StepCost.fit((100, 0.004), (500, 0.002)) == StepCost(0.003, 0.0)  # negative slope by noise
    assert StepCost.fit((100, 0.001), (500, 0.010)) == StepCost(0.0, 2e-5)  # more than in proportion
    phases = StepCost(0.01, 0.0, [[0.0, 0.5], [0.5, 1.0], [0.75, 3.0]])
    assert phases.seconds(5) == pytest.approx(0.0125)
    assert phases.mean(0.6, 1.0) == pytest.approx((0.15 + 0.75) / 0.4) and phases.mean(0.5, 0.6) == pytest.approx(1.0)


def test_mean_population_agrees_with_exponential_growth():
    share = np.linspace(0, 1, 200_001)
    population = np.minimum(1, 0.25 * 4 ** (share / 0.54))
    assert mean_population(0.25) == pytest.approx(population.mean(), abs=1e-4)
    assert mean_population(1.0) == 1.0


@pytest.mark.parametrize("start", [0.25, 0.8, 1.0])
@pytest.mark.parametrize(
    "cost", [StepCost(0.004, 1e-6), StepCost(0.0, 2e-6), StepCost(0.003, 1e-6, ((0.0, 1.0), (0.7, 2.0)))]
)
def test_the_plan_fills_the_time_with_the_given_ratio_of_steps(cost, start):
    plan = plan_training(120.0, cost, start, MANY)
    assert plan.iterations / plan.max_primitives == pytest.approx(STEPS_PER_PRIMITIVE, rel=2e-3)
    taken = plan.iterations * cost.seconds(mean_population(start) * plan.max_primitives)
    assert taken == pytest.approx(120, rel=2e-3) and plan.seconds == pytest.approx(taken)


def test_the_plan_for_constant_cost_per_step():
    assert STEPS_PER_PRIMITIVE > 0
    plan = plan_training(10.0, StepCost(0.002, 0.0), 1.0, MANY)
    assert plan.iterations == pytest.approx(5000, abs=1) and plan.max_primitives == pytest.approx(
        5000 / STEPS_PER_PRIMITIVE, abs=1
    )


def test_the_plan_respects_limits_of_primitives_and_steps():
    cost = StepCost(0.001, 1e-6)
    few = plan_training(1000.0, cost, 1.0, 4000)
    assert (few.max_primitives, few.iterations) == (4000, 200_000) and "pixels" in few.why
    little = plan_training(LEAST_STEPS * cost.seconds(LEAST_PRIMITIVES) * 1.01, cost, 1.0, MANY)
    assert little.max_primitives == pytest.approx(LEAST_PRIMITIVES, rel=0.05) and little.iterations == LEAST_STEPS
    between = plan_training(LEAST_STEPS * cost.seconds(2 * LEAST_PRIMITIVES), cost, 1.0, MANY)
    assert (between.iterations, between.max_primitives) == (LEAST_STEPS, pytest.approx(2 * LEAST_PRIMITIVES, abs=1))
    assert plan_training(LEAST_STEPS * cost.seconds(LEAST_PRIMITIVES) * 0.99, cost, 1.0, MANY) is None


def test_given_steps_or_primitives_are_kept():
    cost = StepCost(0.001, 1e-6)
    assert plan_training(20.0, cost, 1.0, MANY, max_primitives=3000).iterations == 5000
    plan = plan_training(20.0, cost, 1.0, MANY, iterations=5000)
    assert (plan.iterations, plan.max_primitives) == (5000, pytest.approx(3000, abs=1))
    assert plan_training(2.0, cost, 1.0, MANY, iterations=5000) is None
    assert plan_training(-1.0, cost, 1.0, MANY) is plan_training(-1.0, cost, 1.0, MANY, max_primitives=500) is None


def test_the_correction_fills_the_remaining_time():
    assert corrected_steps(600, 1000, 0.01, 4.0) == 1000
    assert corrected_steps(600, 1000, 0.02, 4.0) == 800
    assert corrected_steps(600, 1000, 0.01, -5.0) == 600 + 400 / LARGEST_CORRECTION
    assert corrected_steps(600, 1000, 0.01, 1e9) == 600 + 400 * LARGEST_CORRECTION


def test_the_planned_voxel_size_fills_the_time():
    cost = VoxelCost.fit([(0.4, 1.0 + 0.08 / 0.16), (0.2, 1.0 + 0.08 / 0.04)])
    assert (cost.base, cost.per_area) == pytest.approx((1.0, 0.08))
    voxel = plan_voxel(9.0, cost, 1e-3, 0.4)
    assert voxel == pytest.approx(0.1, rel=0.01) and cost.seconds(voxel) <= 9.0
    assert plan_voxel(1e6, cost, 0.05, 0.4) == pytest.approx(0.05)
    assert plan_voxel(1.4, cost, 0.05, 0.4) is None
    assert VoxelCost.fit([(0.4, 2.0)]).seconds(0.2) == pytest.approx(8.0)  # one pass: all cost is per area
    assert VoxelCost.fit([(0.4, 2.0), (0.2, 1.0)]).seconds(0.1) == pytest.approx(4.0)  # noise


# --- the schedule ----------------------------------------------------------------------------------------


@pytest.fixture
def trainer(tiny_scene, tiny_run):
    run = Run.open(tiny_run)
    images = load_training_images(run.scene().train, run.similarity)
    return start_trainer(run.scene(), run, images, run.train_options, None)


def test_a_correction_stretches_the_remaining_schedule(trainer):
    planned = trainer.options.iterations
    plain = []
    for trainer.step in range(planned):
        plain.append(trainer.part())
        assert trainer.part() == trainer.step / planned and trainer.iterations == planned
    bend, last = 240, 340
    trainer.correction = (bend, last)
    for trainer.step in range(bend):
        assert trainer.part() == plain[trainer.step] and trainer.iterations == planned
    parts = []
    for trainer.step in range(bend, last + 1):
        parts.append(trainer.part())
        assert trainer.iterations == last and trainer.has_reached(0.7) == (trainer.part() >= 0.7)
    assert parts[0] == bend / planned and parts[-1] == pytest.approx(1)
    assert np.diff(parts) == pytest.approx(np.full(last - bend, (1 - bend / planned) / (last - bend)))


def test_the_cost_of_each_phase_is_measured(tiny_run, monkeypatch):
    """Steps take time in proportion to pixels, and three times as much with overlap."""
    monkeypatch.setattr(coarse_images, "coarsest_factor", lambda *_: 4)

    def advance(self):
        factor, overlap = self.coarse.factor(self.part()), self.raster_options_now()["order"] == "overlap"
        self.seconds += len(self) / factor**2 * (3 if overlap else 1)
        self.step += 1

    monkeypatch.setattr(Trainer, "advance", advance)
    run = Run.open(tiny_run)
    images = load_training_images(run.scene().train, run.similarity)
    options = replace(run.train_options, order="overlap", order_from=0.7, max_primitives=100)
    cost, *_ = pacing.calibrate(
        options,
        images,
        None,
        Budget(60.0),
        lambda given: start_trainer(run.scene(), run, images, given, None),
        evaluate,
    )
    assert cost.phases == [(0.0, 1 / 4), (0.45, 1.0), (0.7, 3.0), (0.9, 12.0)]
    assert cost.mean() == pytest.approx(0.45 / 4 + 0.25 + 0.2 * 3 + 0.1 * 12)


# --- whole runs ------------------------------------------------------------------------------------------

OPTIONS = TrainOptions(sh_degree=0, threads=1, evaluate_every=0, checkpoint_every=150)


@pytest.fixture(scope="module")
def budgeted(tiny_scene, tmp_path_factory):
    """(run, result, budget, seconds) of a run with a budget of 12 s, or more on a busy machine."""
    run = tmp_path_factory.mktemp("budget") / "run"

    def timed(budget):
        begin = time.monotonic()
        return train(tiny_scene, run, options=OPTIONS, time_budget=budget, quiet=True), time.monotonic() - begin

    (result, seconds), budget = with_budget(timed, 12.0)
    return run, result, budget, seconds


def test_a_run_stays_within_its_time_budget(budgeted):
    run, result, budget, seconds = budgeted
    # A loaded machine changes its pace by a factor of two or three within such a time, after the one correction too.
    assert 5 / 12 * budget < seconds < 2 * budget
    noted = json.loads((run / "config.json").read_text())["time_budget"]
    assert noted["seconds"] == budget and noted["actual_seconds"] == pytest.approx(seconds, abs=1.0)
    assert noted == json.loads(json.dumps(result["time_budget"]))
    assert noted["correction"]["step"] == round(0.6 * noted["iterations"])
    assert result["iterations"] == noted["correction"]["iterations"]
    opened = Run.open(run)
    assert (opened.train_options.iterations, opened.train_options.max_primitives) == (
        noted["iterations"],
        noted["max_primitives"],
    )
    assert opened.state["iterations"] == result["iterations"] and result["primitives"] <= noted["max_primitives"]
    assert result["psnr"] > 20


def test_resuming_with_a_correction_repeats_the_run_bit_for_bit(tiny_scene, tmp_path, monkeypatch):
    """The run is killed after the correction at step 120, and resumed from checkpoints of steps 120 and 150."""
    options = replace(OPTIONS, iterations=200, max_primitives=100, checkpoint_every=50)
    cost = StepCost(0.001, 0.0)
    monkeypatch.setattr(pacing, "calibrate", lambda *_: (cost, 1.0, 0.0, 0.0))
    monkeypatch.setattr(pacing, "plan_training", lambda *_, **__: time_budget.TrainingPlan(200, 100, 1.0, "a test"))
    monkeypatch.setattr(pacing, "corrected_steps", lambda *_: 180)
    whole = tmp_path / "whole"
    train(tiny_scene, whole, options=replace(options, iterations=7000), time_budget=60.0, quiet=True)
    assert Run.open(whole).state["iteration"] == 180
    advance = Trainer.advance
    for stop in (130, 170):  # after the correction at 120: the checkpoints there are of 120 and of 150
        killed = tmp_path / f"killed_{stop}"

        def die(self, at=stop):
            if self.step == at:
                raise KeyboardInterrupt
            advance(self)

        monkeypatch.setattr(Trainer, "advance", die)
        with pytest.raises(KeyboardInterrupt):
            train(tiny_scene, killed, options=replace(options, iterations=7000), time_budget=60.0, quiet=True)
        monkeypatch.setattr(Trainer, "advance", advance)
        monkeypatch.setattr(pacing, "corrected_steps", lambda *_: pytest.fail("corrected twice"))
        train(tiny_scene, killed, resume=True, quiet=True)
        monkeypatch.setattr(pacing, "corrected_steps", lambda *_: 180)
        assert_same_run(whole, killed)


def test_a_run_killed_before_the_correction_is_corrected_on_resume(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(pacing, "calibrate", lambda *_: (StepCost(0.001, 0.0), 1.0, 0.0, 0.0))
    monkeypatch.setattr(pacing, "plan_training", lambda *_, **__: time_budget.TrainingPlan(200, 100, 1.0, "a test"))

    def die(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(pacing, "corrected_steps", die)
    with pytest.raises(KeyboardInterrupt):
        train(tiny_scene, tmp_path / "run", options=OPTIONS, time_budget=60.0, quiet=True)
    assert Run.open(tmp_path / "run").state["iteration"] == 120
    monkeypatch.setattr(pacing, "corrected_steps", lambda *_: 150)
    assert train(tiny_scene, tmp_path / "run", resume=True, quiet=True)["iterations"] == 150


def test_an_extraction_stays_within_its_time_budget(tiny_run, tmp_path):
    begin = time.monotonic()
    stats = extract_mesh(
        tiny_run, output=tmp_path / "mesh.ply", options=ExtractOptions(level=0.5), time_budget=30.0, quiet=True
    )
    seconds = time.monotonic() - begin
    chosen = stats["time_budget"]
    # It may well be done sooner: a voxel below what the views support shows nothing more.
    assert seconds < 60 and chosen["actual_seconds"] == pytest.approx(seconds, abs=1.0)
    assert stats["voxel_size"] == chosen["voxel_size"] >= chosen["supported_voxel_size"] * (1 - 1e-9)
    cost = VoxelCost(**chosen["cost"])
    assert chosen["predicted_seconds"] == pytest.approx(cost.seconds(chosen["voxel_size"]))
    assert chosen["predicted_seconds"] <= budget.AIM * 30.0
    assert (
        json.loads((tiny_run / "mesh" / "tsdf" / "stats.json").read_text())["time_budget"]["voxel_size"]
        == chosen["voxel_size"]
    )


def test_a_small_budget_gives_a_coarser_surface(tiny_run, tmp_path, monkeypatch):
    """Passes are assumed to take 1 + c / voxel^2 seconds, too long for the finest voxels."""
    cost = VoxelCost(1.0, 1e-2)
    monkeypatch.setattr(voxel_budget, "_timed_pass", lambda run, options, *_: cost.seconds(options.voxel_size))
    supported = extract_mesh(tiny_run, output=tmp_path / "a.ply", options=ExtractOptions(level=0.5), quiet=True)[
        "voxel_size"
    ]
    cost = VoxelCost(1.0, 80.0 * supported**2)
    stats = extract_mesh(
        tiny_run, output=tmp_path / "b.ply", options=ExtractOptions(level=0.5), time_budget=40.0, quiet=True
    )
    left = budget.AIM * 40.0 - 1.0
    assert stats["voxel_size"] == pytest.approx(supported * math.sqrt(80.0 / left), rel=0.15)
    with pytest.raises(LinprimError, match=r"--time-budget is 1 s, but the coarsest surface .* takes \d+ s"):
        extract_mesh(
            tiny_run, output=tmp_path / "c.ply", options=ExtractOptions(level=0.5), time_budget=1.0, quiet=True
        )
    assert not (tmp_path / "c.ply").exists()


# --- errors ----------------------------------------------------------------------------------------------


def test_too_little_time_is_refused_and_leaves_nothing(tiny_scene, tmp_path):
    with pytest.raises(LinprimError, match=r"--time-budget is 0.1 s, but the least training .* takes \d+ s here"):
        train(tiny_scene, tmp_path / "run", options=OPTIONS, time_budget=0.1, quiet=True)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("seconds", [0.0, -1.0, math.nan, math.inf])
def test_budgets_that_are_not_positive_are_refused(seconds, tiny_scene, tmp_path):
    with pytest.raises(LinprimError, match="--time-budget is .* wanted a positive time"):
        Budget(seconds)
    with pytest.raises(LinprimError, match="--time-budget"):
        train(tiny_scene, tmp_path / "run", time_budget=seconds, quiet=True)


def test_a_budget_without_free_options_is_refused(tiny_scene, tiny_run, tmp_path):
    with pytest.raises(LinprimError, match="nothing to choose"):
        train(
            tiny_scene,
            tmp_path / "run",
            options=TrainOptions(iterations=10, max_primitives=50),
            time_budget=5.0,
            quiet=True,
        )
    with pytest.raises(LinprimError, match="--voxel-size"):
        extract_mesh(tiny_run, options=ExtractOptions(voxel_size=0.1), time_budget=5.0, quiet=True)
    with pytest.raises(LinprimError, match="--time-budget is for --method tsdf, not for polyhedra"):
        extract_mesh(tiny_run, "polyhedra", time_budget=5.0, quiet=True)


def test_times_are_parsed_with_units(capsys):
    assert [seconds(text) for text in ("90", "90s", "5m", "1.5h")] == [90, 90, 300, 5400]
    for wrong in ("", "m", "0", "-5s", "5 minutes", "nan", "inf"):
        with pytest.raises(SystemExit) as leaving:
            cli.main(["train", "scene", f"--time-budget={wrong}"])
        assert leaving.value.code == 2
    assert "--time-budget" in capsys.readouterr().err


def test_runs_without_a_budget_record_none(tiny_run):
    assert "time_budget" not in json.loads((tiny_run / "config.json").read_text())
