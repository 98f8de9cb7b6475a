"""Training: photographs and a first guess of primitives in, a run folder with optimised primitives out.

One view per step (trainer.py): render, L1 + D-SSIM, Adam, and now and then the population grows (population.py).
training_start.py says where to start, training_loop.py what surrounds the steps.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import torch

from . import ops
from .camera import Similarity
from .checkpoint import read_checkpoint
from .effects import Choice, Decision
from .errors import LinprimError
from .files import is_remains, locked
from .held_out_gap import gap_advice
from .initial_points import VolumePoints
from .options import GEOMETRY_WEIGHTS, SceneOptions, TrainOptions, check_train_options
from .pacing import Pace, plan_run
from .progress import Progress, duration
from .run import Run, is_unused, refuse_used
from .scene import Scene
from .shots import Shot, load_shots
from .time_budget import Budget
from .training_loop import QUICK_VIEWS, evaluate, run_steps
from .training_start import SFM_START, begin_run, late_terms, reopen_run, start_trainer, with_points


def train(
    scene: str | os.PathLike,
    run: str | os.PathLike,
    scene_options: SceneOptions | None = None,
    options: TrainOptions | None = None,
    *,
    time_budget: Budget | float | None = None,
    resume: bool = False,
    quiet: bool = False,
    effects: Choice | None = None,
    blocks: int | str = 1,
    cluster: str | None = None,
    workers: int = 0,
) -> dict:
    """Trains a scene into a run folder.

    With `resume` the folder's own options are used (but for `threads`): learning rates and growth depend on them. A
    capture that is no longer where it was is looked for at `scene`. Interrupted (Ctrl-C), it finishes the step, saves,
    and raises KeyboardInterrupt.

    With `time_budget`, in seconds from now for everything, a calibration of some dozen steps says what a step costs,
    and `time_budget.plan_training` chooses `iterations` and `max_primitives` from it; one of the two that differs from
    its default is kept. When growth has ended the steps that are left are counted anew, once, from the pace so far.
    Both are in config.json under `time_budget`, so that a resumed run repeats them, with the seconds that the run took.

    With `effects` the options that the scene calls for take the place of those that were not given (effects.py);
    without, all are taken as they are. What was decided is in config.json, and a resumed run keeps it.

    With `blocks` other than 1 the scene is trained in blocks of space by several workers, see
    `block_training.train_blocks`.

    Returns: `run`, `iterations`, `seconds` (of training steps alone), `primitives`, `psnr` (mean over held-out views),
    `views`; with held-out views also `train_psnr`, the mean over at most 31 training views, and `advice` where these
    are far ahead (`held_out_gap.gap_advice`), which is in config.json, too; with `--exposure gain` also `psnr_gain`,
    each render times the gain per channel that brings it nearest to its photograph.

    Raises:
        LinprimError: the scene or an option cannot be used, or the folder exists already.
    """
    run_path = Path(run)
    if blocks != 1 or (resume and "blocks" in _notes(run_path)):
        from .block_training import train_blocks

        if time_budget:
            raise LinprimError("--time-budget plans one training: wanted without --blocks")
        return train_blocks(
            scene,
            run,
            scene_options,
            options,
            blocks=blocks,
            cluster=cluster,
            workers=workers,
            resume=resume,
            quiet=quiet,
            effects=effects,
        )
    check_train_options(options := options or TrainOptions())
    scene_options = scene_options or SceneOptions()
    progress = Progress("train", options.iterations, quiet=quiet)
    before = torch.get_num_threads()
    budget = Budget.of(time_budget)
    if run_path.is_file():
        refuse_used(run_path)
    # Killed before anything was saved, there is nothing to go on from but the options that are given again.
    resume = resume and not (_has_remains(run_path) and is_unused(run_path))
    if resume:
        Run.open(run_path)
    if resume and budget:
        progress.note("--resume goes on with the run's own options: --time-budget ignored")
        budget = None
    if budget and all(
        getattr(options, name) != getattr(TrainOptions, name) for name in ("iterations", "max_primitives")
    ):
        raise LinprimError(
            "--time-budget leaves nothing to choose beside --iterations and --max-primitives: wanted at most one "
            "of the two"
        )
    try:
        # torch only does small element-wise work here; its own threads would wait for each other longer than they
        # compute.
        torch.set_num_threads(1)
        with locked(run_path, "trained into"):
            ops.set_threads(options.threads)
            if resume:
                opened, loaded = reopen_run(Path(scene), run_path, scene_options, options, progress)
                return train_run(opened, loaded, read_checkpoint(run_path), progress)
            opened, loaded, decisions = begin_run(
                Path(scene), run_path, scene_options, options, effects or Choice("none"), progress
            )
            return train_run(opened, loaded, None, progress, decisions, budget)
    finally:
        torch.set_num_threads(before)


def _notes(path: Path) -> dict:
    """What a run's config.json holds; nothing where there is none that can be read, which is told later."""
    try:
        return Run(path, path, SceneOptions(), TrainOptions(), Similarity()).notes
    except LinprimError:
        return {}


def _has_remains(path: Path) -> bool:
    """Whether a training that was killed has left something."""
    return path.is_dir() and any(is_remains(entry) for entry in path.iterdir())


def train_run(
    run: Run,
    scene: Scene,
    state: dict | None,
    progress: Progress,
    decisions: Sequence[Decision] = (),
    budget: Budget | None = None,
) -> dict:
    """Trains from a checkpoint's `state`, or from the start: what is random does not depend on when a run was stopped.

    Args:
        run: a new run has no folder yet.
        decisions, budget: of a new run, for its config.json.

    Returns, raises: as `train`.
    """
    options = run.train_options
    wanted = [name for name in GEOMETRY_WEIGHTS if getattr(options, name) > 0]
    if state is None or wanted:
        scene = with_points(scene, options, progress.note)
    shots = load_shots(scene.train, run.similarity)
    if all(shot.alpha is not None and int(shot.alpha.max()) == 0 for shot in shots):
        raise LinprimError(f"{scene.root}: the masks leave no pixel of any training image")
    held_out: list[Shot] | None = None
    pace = None
    if budget:
        held_out = load_shots(scene.test, run.similarity)
        volume = isinstance(scene.points, VolumePoints)
        run, pace = plan_run(
            run,
            shots,
            held_out,
            late_terms(run, scene, shots, progress),
            budget,
            progress,
            start=lambda options: start_trainer(scene, run, shots, options, None),
            score=evaluate,
            # The smaller limit that is chosen leaves too many points, not too few, and volumes are filled anew.
            start_share=0.0 if volume else SFM_START,
            quick_views=len(held_out[:: max(1, len(held_out) // QUICK_VIEWS)]),
        )
        options, progress.total = run.train_options, run.train_options.iterations
        if volume:  # as many as the population begins with
            scene = with_points(replace(scene, points=None), options, progress.note)
    trainer = start_trainer(scene, run, shots, options, state)
    trainer.terms = late_terms(run, scene, shots, progress)
    if not (run.path / "config.json").exists():
        Run.create(
            run.path,
            scene,
            run.scene_path,
            run.scene_options,
            run.train_options,
            run.similarity,
            ops.instruction_set(),
            [asdict(decision) for decision in decisions],
            pace.record if pace else None,
        )
    elif "time_budget" in run.notes:
        pace = Pace.resumed(run, trainer)
    for torn in [*run.path.glob(".*.tmp*"), *run.path.glob("checkpoints/.*.tmp*")]:  # what a kill left half-written
        torn.unlink()
    progress.start = trainer.step
    progress.note(
        f"{scene.root}: {scene.kind}, {len(scene.train)} training and {len(scene.test)} held-out views of "
        f"{shots[0].camera.width}x{shots[0].camera.height}; {len(trainer)} primitives, {ops.instruction_set()}, "
        f"{ops.threads()} threads"
    )
    held_out = load_shots(scene.test, run.similarity) if held_out is None else held_out
    seconds, score, score_gain = run_steps(trainer, run, held_out, progress, pace)
    result = {
        "run": str(run.path),
        "iterations": trainer.step,
        "seconds": seconds,
        "primitives": len(trainer),
        "psnr": score,
        "views": len(held_out),
    }
    if trainer.exposure is not None:
        result["psnr_gain"] = score_gain
    progress.note(
        f"{run.path}: {trainer.step} steps in {duration(seconds)}, {len(trainer)} primitives"
        + (f", held-out PSNR {score:.2f} dB over {len(held_out)} views" if held_out else "")
        + (f", {score_gain:.2f} dB with the best gain of each" if held_out and score_gain is not None else "")
    )
    if score is not None:
        train_score = evaluate(trainer, shots[:: max(1, len(shots) // QUICK_VIEWS)])
        assert train_score is not None
        result["train_psnr"] = train_score
        effects = run.notes.get("effects")
        if advice := gap_advice(train_score, score, len(shots), options, effects if isinstance(effects, list) else []):
            progress.note(advice)
            result["advice"] = advice
            run.note("advice", advice)
    if pace:
        result["time_budget"] = pace.close(run, progress)
    return result
