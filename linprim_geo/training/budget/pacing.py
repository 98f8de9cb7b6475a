"""Keep a training within a time budget: measure the cost of a step, plan the run from it, and correct the number of
steps once during the run."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch

from linprim_geo.base.budget import AIM, Budget
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import GEOMETRY_WEIGHTS, TrainOptions
from linprim_geo.base.progress import Progress
from linprim_geo.runs.run import Run
from linprim_geo.training.budget.plan import (
    GROWTH_END,
    PIXELS_PER_PRIMITIVE,
    SAVE_SECONDS,
    StepCost,
    corrected_steps,
    least_training,
    plan_training,
)
from linprim_geo.training.step.geometry_terms import GeometryTerms
from linprim_geo.training.step.trainer import SHARED, Trainer
from linprim_geo.training.step.training_images import TrainingImage

# Calibration: CALIBRATION_STEPS steps are timed for each of two populations, in turn, after CALIBRATION_WARM_UP rounds.
# The smaller population has CALIBRATION_PART of the primitives of the larger. Timing stops early after
# CALIBRATION_SHARE of the budget.
CALIBRATION_STEPS, CALIBRATION_PART, CALIBRATION_WARM_UP, CALIBRATION_SHARE = 20, 0.25, 2, 0.08
# The pace is measured from this share of the planned steps to the end of growth.
PACE_FROM = 0.5


@dataclass
class Pace:
    """The time budget of a run while it trains, and its entry in config.json (`record`)."""

    budget: Budget
    record: dict
    finish: float  # seconds needed after the last step
    mark: tuple[int, float] | None = None  # step and time.monotonic() at which measuring the pace began

    @staticmethod
    def resumed(run: Run, trainer: Trainer) -> Pace:
        """Restore the pace of a resumed run from config.json and the seconds that its steps have taken. A correction
        made earlier is applied again."""
        try:
            record = dict(run.notes["time_budget"])
            correction = record.get("correction")
            if correction:
                bend, last = int(correction["step"]), int(correction["iterations"])
                if not 0 < bend < last:
                    raise ValueError(f"corrected at step {bend} to {last}")
                trainer.correction = (bend, last)
            spent, finish = (float(record.get(name, 0.0)) for name in ("before_seconds", "finish_seconds"))
            if not (math.isfinite(spent) and math.isfinite(finish)):
                raise ValueError(f"seconds are {spent} and {finish}")
            return Pace(Budget(float(record["seconds"]), time.monotonic() - trainer.seconds - spent), record, finish)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise LinprimError(
                f"{run.path / 'config.json'}: its time_budget lacks what a run needs ({error})"
            ) from None

    def watch(self, trainer: Trainer, run: Run, progress: Progress, save: Callable[[], None]) -> None:
        """Call before every step: measure the pace, and once growth has ended, correct the number of steps."""
        planned = trainer.options.iterations
        end = max(1, round(GROWTH_END * planned))
        if trainer.correction is not None or trainer.step > end:
            return
        if self.mark is None and trainer.step >= PACE_FROM * planned:
            self.mark = (trainer.step, time.monotonic())
        if trainer.step < end or trainer.step >= planned:
            return
        begin = time.monotonic()
        save()
        saving = time.monotonic() - begin
        finish = self.finish - SAVE_SECONDS + saving
        since, then = self.mark if self.mark and self.mark[0] < trainer.step else (0, self.budget.began)
        per_step = (begin - then) / (trainer.step - since)
        # Later phases cost more, by the ratio measured in the calibration.
        cost = StepCost(1.0, 0.0, self.record["cost"].get("phases", StepCost.phases))
        per_step *= cost.mean(GROWTH_END, 1.0) / cost.mean(since / planned, GROWTH_END)
        last = corrected_steps(trainer.step, planned, per_step, self.budget.left() - finish)
        self.record["correction"] = {
            "step": trainer.step,
            "iterations": last,
            "planned": planned,
            "elapsed_seconds": self.budget.elapsed(),
            "step_seconds": per_step,
        }
        run.note("time_budget", self.record)
        trainer.correction = (trainer.step, last)
        progress.total = last
        progress.note(
            f"  {self.budget.elapsed():.0f} s of {self.budget.seconds:.3g} s at step {trainer.step}, "
            f"{1e3 * per_step:.1f} ms a step: "
            f"{last} steps in all in place of {planned}"
        )

    def close(self, run: Run, progress: Progress) -> dict:
        """Record the seconds that the run took, unless the run had finished before."""
        if "actual_seconds" in self.record:
            return self.record
        self.record["actual_seconds"] = self.budget.elapsed()
        run.note("time_budget", self.record)
        progress.note(f"  {self.budget.elapsed():.1f} s of the {self.budget.seconds:.3g} s")
        return self.record


def plan_run(
    run: Run,
    images: list[TrainingImage],
    held_out: list[TrainingImage],
    terms: GeometryTerms | None,
    budget: Budget,
    progress: Progress,
    *,
    start: Callable[[TrainOptions], Trainer],
    score: Callable[[Trainer, list[TrainingImage]], object],
    start_share: float,
    quick_views: int,
) -> tuple[Run, Pace]:
    """Return the run with the number of steps and primitives that fill the budget, from the measured cost of a step.

    Args:
        start: makes a trainer at step 0 with the given options. score: evaluates a trainer on some views.
        start_share: lower bound of the initial number of primitives, as a share of the limit.
        quick_views: number of held-out views scored during training.

    Raises:
        LinprimError: not even the smallest useful training fits.
    """
    options = run.train_options
    given = {
        name: value
        for name, value in (("iterations", options.iterations), ("max_primitives", options.max_primitives))
        if value != getattr(TrainOptions, name)
    }
    begin = time.monotonic()
    cost, begun, starting, view_seconds = calibrate(run.train_options, images, terms, budget, start, score)
    calibrating = time.monotonic() - begin
    # Time other than steps: scores and checkpoints during training, and both at the end.
    beside = SAVE_SECONDS / options.checkpoint_every
    beside += view_seconds * quick_views / options.evaluate_every if options.evaluate_every else 0.0
    cost = replace(cost, base=cost.base + beside)
    finish = SAVE_SECONDS + view_seconds * len(held_out)
    pixels = sum(image.camera.width * image.camera.height for image in images)
    left = budget.left() - starting - SAVE_SECONDS - finish
    plan = plan_training(left, cost, max(begun, start_share), max(1, pixels // PIXELS_PER_PRIMITIVE), **given)
    if plan is None:
        least = (AIM * budget.seconds - left + least_training(cost, **given)) / AIM
        raise LinprimError(
            f"--time-budget is {budget.seconds:.3g} s, but the least training of this scene that is of any use "
            f"takes {least:.0f} s here"
        )
    progress.note(
        f"  a step takes {1e3 * cost.base:.2f} ms + {1e6 * cost.per_primitive:.2f} ms per 1000 primitives: "
        f"{plan.iterations} steps, "
        f"{plan.max_primitives} primitives at most ({plan.why}), {plan.seconds:.0f} s of the {budget.seconds:.3g} s"
    )
    options = replace(options, iterations=plan.iterations, max_primitives=plan.max_primitives)
    options = replace(options, initial_primitives=min(options.initial_primitives, options.max_primitives))
    record = {
        "seconds": budget.seconds,
        "iterations": plan.iterations,
        "max_primitives": plan.max_primitives,
        "why": plan.why,
        "cost": asdict(cost),
        "calibration_seconds": calibrating,
        "before_seconds": budget.elapsed() + starting,
        "finish_seconds": finish,
        "planned_seconds": plan.seconds,
    }
    return replace(run, train_options=options), Pace(budget, record, finish)


def calibrate(
    options: TrainOptions,
    images: list[TrainingImage],
    terms: GeometryTerms | None,
    budget: Budget,
    start: Callable[[TrainOptions], Trainer],
    score: Callable[[Trainer, list[TrainingImage]], object],
) -> tuple[StepCost, float, float, float]:
    """Measure the cost of training steps.

    Returns: the cost of a step, the initial population as a share of its limit, seconds to make the first population,
    and seconds to score a view.

    Two temporary trainers take steps in turn. They are set to the end of growth, where all spherical harmonics degrees
    are in use. The larger one also takes steps in the other phases of a run, at the end of each.
    """
    options = replace(options, iterations=TrainOptions.iterations)
    begin = time.monotonic()
    large = start(options)
    starting = time.monotonic() - begin
    begun = len(large) / options.max_primitives
    part = max(1, round(CALIBRATION_PART * len(large)))
    keep = torch.from_numpy(np.sort(np.random.default_rng([options.seed, 1]).choice(len(large), part, replace=False)))
    fewer = {name: value[keep].clone() for name, value in large.parameters.items() if name not in SHARED}
    fewer["log_extent"] += float(np.log(len(large) / part)) / 2  # keep the number of primitives over each surface point
    fewer["log_extent"].clamp_(*(float(np.log(bound)) for bound in large.bounds))
    environment = None if large.environment is None else large.environment.clone()
    small = Trainer(
        images,
        fewer,
        options,
        large.bounds,
        large.background.clone(),
        large.fitted,
        large.random_background,
        terms,
        environment=environment,
    )
    large.terms = terms
    until = time.monotonic() + CALIBRATION_SHARE * budget.seconds
    starts = _phases(large)
    growing = [start for start in starts if start <= GROWTH_END][-1]
    grown, timed = round(GROWTH_END * options.iterations) + 1, CALIBRATION_WARM_UP + CALIBRATION_STEPS + 1
    # The trainer and the first step of each kind of steps. Phases other than that at the end of growth are named by
    # their start, and timed before their end.
    steps: dict[object, tuple[Trainer, int]] = {"small": (small, grown), growing: (large, grown)}
    for start, end in zip(starts, [*starts[1:], 1.0], strict=True):
        steps.setdefault(start, (large, max(0, round(end * options.iterations) - timed)))
    times: dict[object, list[float]] = {kind: [] for kind in steps}
    for turn in range(CALIBRATION_WARM_UP + CALIBRATION_STEPS):
        if turn > CALIBRATION_WARM_UP + 2 and time.monotonic() > until:
            break
        for kind, (trainer, first) in steps.items():
            trainer.step = first + turn
            trainer.seconds = 0.0
            trainer.advance()
            if turn >= CALIBRATION_WARM_UP:
                times[kind].append(trainer.seconds)
    mean = {kind: float(np.mean(values)) for kind, values in times.items()}
    begin = time.monotonic()
    score(large, images[:2])
    view_seconds = (time.monotonic() - begin) / len(images[:2])
    phases = [(start, mean[start] / mean[growing]) for start in starts]
    cost = StepCost.fit((part, mean["small"]), (len(large), mean[growing]), phases)
    return cost, begun, starting, view_seconds


def _phases(trainer: Trainer) -> list[float]:
    """Return the shares of a run at which its steps change their cost, from 0 on: sizes of photographs, late terms of
    the loss, and the order of blending."""
    options = trainer.options
    starts = {start for start, _ in trainer.coarse.phases()}
    starts |= {options.order_from if options.order != "center" else 0.0}
    starts |= {options.geometry_from if any(getattr(options, name) > 0 for name in GEOMETRY_WEIGHTS) else 0.0}
    return sorted(start for start in starts if start < 1)
