"""Train a scene: photographs in, a run folder with optimised primitives out, as one model or in blocks.

`single.train_run` trains one model. A step (`step.trainer.Trainer.advance`) renders a view, computes L1 + D-SSIM, and
updates with Adam; at intervals density control adds and moves primitives. start.py makes the initial primitives,
loop.py runs the steps.
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
    """Train a scene into a run folder.

    With `resume`, the run's own options are used (except `threads`), because learning rates and growth depend on them.
    If the capture is no longer at its recorded path, it is looked for at `scene`. On Ctrl-C the current step is
    finished and saved, then KeyboardInterrupt is raised.

    With `time_budget`, in seconds from now for everything, a calibration of some dozen steps measures the cost of a
    step, and `budget.plan.plan_training` chooses `iterations` and `max_primitives` from it. If one of the two differs
    from its default, it is kept. When growth has ended, the number of remaining steps is corrected once from the
    measured pace. Plan and correction are stored in config.json under `time_budget`, with the seconds that the run
    took, so that a resumed run repeats them.

    With `effects`, the options that the scene calls for replace those that were not given (effects.py); without it, all
    options are used as they are. The decisions are stored in config.json and kept by a resumed run.

    With `blocks` other than 1, the scene is split in space and trained by several workers, see
    `blocks.driver.train_blocks`.

    `advance` performs one step instead of `Trainer.advance`, from step 0 of a new run; to measure steps, pass a
    function that calls `Trainer.advance`. Blocks ignore it.

    Returns: `run`, `iterations`, `seconds` (of training steps alone), `primitives`, `psnr` (mean over held-out views),
    `views`. With held-out views also `train_psnr`, the mean over at most 31 training views, and, if it is far above
    `psnr`, `advice` (`held_out_gap.gap_advice`), which is stored in config.json too. With `--exposure gain` also
    `psnr_gain`, the mean PSNR after multiplying each render by its best gain per channel; `train_psnr` is then computed
    in the same way.

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
    # A run that was killed before anything was saved has nothing to resume from: start it anew with the options given
    # now.
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
        # torch only does small element-wise work here; with several threads it would spend more time synchronising than
        # computing.
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
    """Return the contents of a run's config.json, or {} if it is missing or unreadable; the error is reported later."""
    try:
        return Run(path, path, SceneOptions(), TrainOptions(), Similarity()).notes
    except LinprimError:
        return {}
