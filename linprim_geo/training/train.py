"""Training a scene: photographs in, a run folder with optimised primitives out, whole or in blocks.

`single.train_run` is one training; its step is `step.trainer.Trainer.advance`: render a view, L1 + D-SSIM, Adam, and
now and then density control. start.py makes the first primitives, loop.py runs the steps.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import torch

from linprim_geo.base.budget import Budget
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import locked
from linprim_geo.base.options import SceneOptions, TrainOptions, check_train_options
from linprim_geo.base.progress import Progress
from linprim_geo.geometry.camera import Similarity
from linprim_geo.kernels import ops
from linprim_geo.runs.run import Run, is_unused, refuse_used
from linprim_geo.training.checkpoint import read_checkpoint
from linprim_geo.training.effects import Choice
from linprim_geo.training.single import train_run
from linprim_geo.training.start import begin_run, reopen_run
from linprim_geo.training.step.trainer import Trainer


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
    advance: Callable[[Trainer], None] | None = None,
) -> dict:
    """Trains a scene into a run folder.

    With `resume` the folder's own options are used (but for `threads`): learning rates and growth depend on them. A
    capture that is no longer where it was is looked for at `scene`. Interrupted (Ctrl-C), it finishes the step, saves,
    and raises KeyboardInterrupt.

    With `time_budget`, in seconds from now for everything, a calibration of some dozen steps says what a step costs,
    and `budget.plan.plan_training` chooses `iterations` and `max_primitives` from it; one of the two that differs from
    its default is kept. When growth has ended the steps that are left are counted anew, once, from the pace so far.
    Both are in config.json under `time_budget`, so that a resumed run repeats them, with the seconds that the run took.

    With `effects` the options that the scene calls for take the place of those that were not given (effects.py);
    without, all are taken as they are. What was decided is in config.json, and a resumed run keeps it.

    With `blocks` other than 1 the scene is trained in blocks of space by several workers, see
    `blocks.driver.train_blocks`.

    `advance` makes one step in place of `Trainer.advance`, from step 0 of a new run on: who measures steps
    gives a function that calls that in it. Blocks are trained without it.

    Returns: `run`, `iterations`, `seconds` (of training steps alone), `primitives`, `psnr` (mean over held-out views),
    `views`; with held-out views also `train_psnr`, the mean over at most 31 training views, and `advice` where these
    are far ahead (`held_out_gap.gap_advice`), which is in config.json, too; with `--exposure gain` also `psnr_gain`,
    each render times the gain per channel that brings it nearest to its photograph, as it is for `train_psnr` then.

    Raises:
        LinprimError: the scene or an option cannot be used, or the folder exists already.
    """
    run_path = Path(run)
    if blocks != 1 or (resume and "blocks" in _notes(run_path)):
        from linprim_geo.training.blocks.driver import train_blocks

        if time_budget:
            raise LinprimError("--time-budget plans one training: wanted without --blocks")
        trained = train_blocks(
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
        if trained is not None:
            return trained
    check_train_options(options := options or TrainOptions())
    scene_options = scene_options or SceneOptions()
    progress = Progress("train", options.iterations, quiet=quiet)
    before = torch.get_num_threads()
    budget = Budget.of(time_budget)
    if run_path.is_file():
        refuse_used(run_path)
    # Killed before anything was saved, there is nothing to go on from but the options that are given again.
    resume = resume and not (run_path.is_dir() and is_unused(run_path))
    if resume:
        Run.open(run_path)
    if (
        budget
        and not resume
        and all(getattr(options, name) != getattr(TrainOptions, name) for name in ("iterations", "max_primitives"))
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
                given = {"--time-budget": budget, "--cluster": cluster, "--workers": workers}
                ignored = [flag for flag, value in given.items() if value]
                opened, loaded = reopen_run(Path(scene), run_path, scene_options, options, progress, effects, ignored)
                return train_run(opened, loaded, read_checkpoint(run_path), progress, advance=advance)
            opened, loaded, decisions = begin_run(
                Path(scene), run_path, scene_options, options, effects or Choice("none"), progress
            )
            return train_run(opened, loaded, None, progress, decisions, budget, advance)
    finally:
        torch.set_num_threads(before)


def _notes(path: Path) -> dict:
    """What a run's config.json holds; nothing where there is none that can be read, which is told later."""
    try:
        return Run(path, path, SceneOptions(), TrainOptions(), Similarity()).notes
    except LinprimError:
        return {}
