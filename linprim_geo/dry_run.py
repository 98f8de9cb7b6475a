"""What a training would take, before it is begun: images, primitives, minutes and memory, by timing a few steps of
it."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path

import torch

from . import ops
from .effects import Choice
from .fuse import available_memory
from .options import SceneOptions, TrainOptions, check_train_options
from .pacing import calibrate, plan_run
from .primitives import KINDS
from .progress import Progress, duration, memory_gib
from .scene import View
from .shots import StoredShot, load_shots, photo_bytes, photo_limit
from .time_budget import SAVE_SECONDS, Budget, mean_population
from .trainer import Trainer
from .training_loop import QUICK_VIEWS, evaluate
from .training_start import SFM_START, begin_run, late_terms, start_trainer

# Timing takes at most CALIBRATION_SHARE of so many seconds.
TIMING = 125.0
# Bytes that a primitive takes while a step is made: so many in any case, and so many for each of its numbers, with
# Adam's moments and gradients. Fitted to 300,000 octahedra of degree 1 and 3 (1560 and 2340 bytes measured); Gaussians
# of degree 3 take 17 % less.
PRIMITIVE_BYTES, NUMBER_BYTES = 1060, 21.6
# What a process takes in any case, libraries above all, and each pixel of the image that is at work.
PROCESS_GIB, PIXEL_BYTES = 0.45, 300


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
    """What `train` with the same arguments would do and take. Nothing is written but the cache of points and
    undistorted photographs.

    Returns: `images` and `held_out`, `width` and `height` of the largest image, `photo_gib` that all would take,
        `photos_in_memory` (how many stay there), `iterations`, `max_primitives`, `minutes`, `memory_gib` (at its peak),
        `available_gib`, `fits`, and `advice`, what to change where it does not fit, else "".

    Accuracy: memory within a quarter of what a training takes, or 0.3 GiB; minutes are those of this machine as busy as
    it is now.

    Raises:
        LinprimError: what `train` would raise before its first step.
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
        # What is there now is what would be there for all of it.
        limit = photo_limit()
        shots, held_out = (load_shots(views, planned.similarity) for views in (loaded.train, loaded.test))
        terms = late_terms(planned, loaded, shots, progress)

        counts = []

        def start(options: TrainOptions) -> Trainer:
            trainer = start_trainer(loaded, planned, shots, options, None)
            counts.append(len(trainer))
            return trainer

        if budget:
            quick = len(held_out[:: max(1, len(held_out) // QUICK_VIEWS)])
            timed, pace = plan_run(
                planned,
                shots,
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
            cost, begun, starting, per_view = calibrate(options, shots, terms, Budget(TIMING), start, evaluate)
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
    per_primitive = bytes_per_primitive(options)
    used = (memory_gib("VmHWM") or memory_gib()) - per_primitive * counts[0] / 2**30  # without those that were timed
    available = available_memory() / 2**30 + memory_gib()
    needed = used + per_primitive * options.max_primitives / 2**30
    held = sum(not isinstance(shot, StoredShot) for shot in shots)
    size = max((view.camera for view in loaded.train), key=lambda camera: camera.width * camera.height)
    photos = photo_bytes(loaded.train)
    report = {
        "images": len(shots),
        "held_out": len(held_out),
        "width": size.width,
        "height": size.height,
        "photo_gib": photos / 2**30,
        "photos_in_memory": held,
        "iterations": options.iterations,
        "max_primitives": options.max_primitives,
        "minutes": seconds / 60,
        "memory_gib": needed,
        "available_gib": available,
        "fits": needed <= available,
        "advice": "" if needed <= available else _advice(used, available, per_primitive, options),
    }
    return report | {"_text": describe(report, limit / 2**30)}


def describe(report: dict, limit_gib: float) -> str:
    """The report as lines for a person; `limit_gib` is what photographs may take."""
    kept = "all in memory"
    if report["photos_in_memory"] < report["images"]:
        kept = (
            f"{report['photos_in_memory']} in memory, which is {limit_gib:.1f} GiB, and the others read when "
            "they are due"
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


def bytes_per_primitive(options: TrainOptions) -> float:
    """What one more primitive takes in memory."""
    numbers = 3 + 4 + KINDS[options.primitive].extents + 1 + 3 * (options.sh_degree + 1) ** 2
    return PRIMITIVE_BYTES + NUMBER_BYTES * numbers


def memory_estimate(
    views: Sequence[View], options: TrainOptions, photos: int | None = None, largest: int | None = None
) -> float:
    """GiB that a process takes at its peak which trains these views, without trying; photographs count in full.

    Args:
        photos: bytes of the photographs, and `largest`, pixels of the largest one, if they are not those of the views.
    """
    photos = photo_bytes(tuple(views)) if photos is None else photos
    largest = max((view.camera.width * view.camera.height for view in views), default=0) if largest is None else largest
    primitives = bytes_per_primitive(options) * options.max_primitives
    return PROCESS_GIB + (photos + PIXEL_BYTES * options.samples**2 * largest + primitives) / 2**30


def _advice(used: float, available: float, per_primitive: float, options: TrainOptions) -> str:
    """What to change so that it fits: fewer primitives if these are what does not, else smaller images."""
    most = int((available - used) * 2**30 / per_primitive) // 1000 * 1000
    if most >= min(10_000, options.max_primitives):
        return f"it would not fit: wanted --max-primitives {most} or less, or more memory"
    return (
        "it would not fit: wanted --downscale 2 or more, or more memory, for the images alone take more than there is"
    )
