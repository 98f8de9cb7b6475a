"""Predict what a training would take (images, primitives, minutes, memory) by timing a few of its steps."""

from __future__ import annotations

import os
import time
from pathlib import Path

import torch

from linprim_geo.base.budget import Budget
from linprim_geo.base.memory import available_memory, memory_gib, peak_gib
from linprim_geo.base.options import SceneOptions, TrainOptions, check_train_options
from linprim_geo.base.progress import Progress, duration
from linprim_geo.kernels import ops
from linprim_geo.points.start_points import SFM_START
from linprim_geo.training.budget.memory import bytes_per_primitive
from linprim_geo.training.budget.pacing import calibrate, plan_run
from linprim_geo.training.budget.plan import SAVE_SECONDS, mean_population
from linprim_geo.training.effects import Choice
from linprim_geo.training.loop import QUICK_VIEWS, evaluate
from linprim_geo.training.start import begin_run, geometry_terms, start_trainer
from linprim_geo.training.step.trainer import Trainer
from linprim_geo.training.step.training_images import LazyTrainingImage, load_training_images, photo_bytes, photo_limit
from linprim_geo.training.stereo_surfaces import stereo_surfaces

# Seconds. The timing of steps takes at most CALIBRATION_SHARE of this.
TIMING = 125.0


def dry_run(
    scene: str | os.PathLike,
    run: str | os.PathLike,
    scene_options: SceneOptions | None = None,
    options: TrainOptions | None = None,
    *,
    time_budget: Budget | float | None = None,
    quiet: bool = False,
    effects: Choice | None = None,
) -> dict:
    """Predict what `train` would do and need if called with the same arguments.

    Nothing is written except the cache of points and undistorted photographs.

    Returns: `images` and `held_out` (numbers of views), `width` and `height` of the largest image, `photo_gib` (size of
    all photographs in memory), `photo_limit_gib` (how much of that may stay in memory), `photos_in_memory` (number of
    photographs kept there), `iterations`, `max_primitives`, `minutes`, `memory_gib` (peak), `available_gib`, `fits`,
    and `advice` (what to change if it does not fit, else "").

    Accuracy: memory is within a quarter of what a training takes, or within 0.3 GiB; minutes are for this machine at
    its current load.

    Raises:
        LinprimError: whatever `train` would raise before its first step.
    """
    check_train_options(options := options or TrainOptions())
    budget, began = Budget.of(time_budget), time.monotonic()
    progress = Progress("dry run", options.iterations, quiet=quiet)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        ops.set_threads(options.threads)
        effects, scene_options = effects or Choice("none"), scene_options or SceneOptions()
        planned, loaded, _ = begin_run(Path(scene), Path(run), scene_options, options, effects, progress)
        # Taken before anything is loaded: the memory that is free now is the memory that a training would start with.
        limit = photo_limit()
        images, held_out = (load_training_images(views, planned.similarity) for views in (loaded.train, loaded.test))
        surfaces = stereo_surfaces(loaded, planned.train_options, progress, budget)
        terms = geometry_terms(planned, loaded, images, surfaces, progress)

        counts = []

        def start(options: TrainOptions) -> Trainer:
            trainer = start_trainer(loaded, planned, images, options, None, surfaces=surfaces)
            counts.append(len(trainer))
            return trainer

        if budget:
            quick = len(held_out[:: max(1, len(held_out) // QUICK_VIEWS)])
            timed, pace = plan_run(
                planned,
                images,
                held_out,
                terms,
                budget,
                progress,
                start=start,
                score=evaluate,
                start_share=SFM_START,
                quick_views=quick,
            )
            options, seconds = timed.train_options, budget.seconds
        else:
            options = planned.train_options
            setup = time.monotonic() - began
            cost, begun, starting, per_view = calibrate(options, images, terms, Budget(TIMING), start, evaluate)
            rounds = options.iterations // options.evaluate_every if options.evaluate_every else 0
            scored = len(held_out) + rounds * min(len(held_out), QUICK_VIEWS)
            steps = options.iterations * cost.seconds(options.max_primitives * mean_population(begun))
            seconds = (
                setup
                + starting
                + steps
                + scored * per_view
                + SAVE_SECONDS * (1 + options.iterations / options.checkpoint_every)
            )
    finally:
        torch.set_num_threads(before)
    size = max((view.camera for view in loaded.train), key=lambda camera: camera.width * camera.height)
    return {
        "images": len(images),
        "held_out": len(held_out),
        "width": size.width,
        "height": size.height,
        "photo_gib": photo_bytes(loaded.train) / 2**30,
        "photo_limit_gib": limit / 2**30,
        "photos_in_memory": sum(not isinstance(image, LazyTrainingImage) for image in images),
        "iterations": options.iterations,
        "max_primitives": options.max_primitives,
        "minutes": seconds / 60,
        **_memory(options, counts[0], loaded.downscale),
    }


def _memory(options: TrainOptions, timed: int, downscale: int) -> dict:
    """Return the memory needed and available, measured after `timed` primitives were trained briefly on photographs
    averaged down by `downscale`."""
    per_primitive = bytes_per_primitive(options)
    used = peak_gib() - per_primitive * timed / 2**30  # subtract the primitives that were used for timing
    available = available_memory() / 2**30 + memory_gib()
    needed = used + per_primitive * options.max_primitives / 2**30
    return {
        "memory_gib": needed,
        "available_gib": available,
        "fits": needed <= available,
        "advice": "" if needed <= available else _advice(used, available, per_primitive, options, downscale),
    }


def describe(report: dict) -> str:
    """Format the report of `dry_run` as lines of text."""
    kept = "all in memory"
    if report["photos_in_memory"] < report["images"]:
        kept = (
            f"{report['photos_in_memory']} in memory, which is {report['photo_limit_gib']:.1f} GiB, and the others "
            "read when they are due"
        )
    lines = [
        f"images: {report['images']} for training of {report['width']}x{report['height']}, "
        f"{report['photo_gib']:.2f} GiB, {kept};"
        f" {report['held_out']} held out",
        f"primitives: {report['max_primitives']} at most, {report['iterations']} steps",
        f"time: {duration(60 * report['minutes'])}",
        f"memory: {report['memory_gib']:.1f} GiB of {report['available_gib']:.1f} GiB that are available",
    ]
    return "\n".join([*lines, *([report["advice"]] if report["advice"] else []), "nothing was written"])


def _advice(used: float, available: float, per_primitive: float, options: TrainOptions, downscale: int) -> str:
    """Return what to change so that the training fits: fewer primitives if they are the problem, else a larger
    downscale than `downscale`."""
    most = int((available - used) * 2**30 / per_primitive) // 1000 * 1000
    if most >= min(10_000, options.max_primitives):
        return f"it would not fit: wanted --max-primitives {most} or less, or more memory"
    return (
        f"it would not fit: wanted --downscale {downscale + 1} or more, or more memory, for the images alone take more "
        "than there is"
    )
