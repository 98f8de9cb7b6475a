"""The training loop: steps, held-out scores, metrics.jsonl, checkpoints, and saving on Ctrl-C."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write, readable_write_errors
from linprim_geo.base.memory import memory_gib
from linprim_geo.base.progress import Progress, duration
from linprim_geo.runs.run import Run
from linprim_geo.training.budget.pacing import Pace
from linprim_geo.training.checkpoint import write_checkpoint
from linprim_geo.training.step.exposure import Exposure, with_best_gain
from linprim_geo.training.step.trainer import Trainer
from linprim_geo.training.step.training_images import TrainingImage, UnreadablePhoto

# Number of held-out views scored during training, roughly: every n-th view is taken. All are scored at the end.
QUICK_VIEWS = 16


def run_steps(
    trainer: Trainer,
    run: Run,
    held_out: list[TrainingImage],
    progress: Progress,
    pace: Pace | None = None,
    until: int | None = None,
    advance: Callable[[Trainer], None] | None = None,
) -> tuple[float, float | None, float | None]:
    """Run training steps to the end, or up to step `until`, and write metrics.jsonl, checkpoints and held-out scores.

    Scores on `held_out` are computed every `evaluate_every` steps and at the end. `advance` performs one step instead
    of `Trainer.advance`.

    Returns: seconds spent in steps; the final mean held-out PSNR in dB as rendered; and the same after the best gain
    per channel if exposures are fitted, else None. Both are None without held-out views.

    Raises:
        LinprimError: training diverged, or a photograph or the run's folder has disappeared. Files saved before stay
            intact.
        KeyboardInterrupt: on Ctrl-C, after the current step is finished and saved.
    """
    options = trainer.options
    table = run.path / "metrics.jsonl"
    cut_metrics(table, trainer.step)
    score = score_gain = None
    saved = -1
    with readable_write_errors(table), open(table, "a") as log, _interrupt_flag() as interrupted:
        while trainer.step < (until or trainer.iterations) and not interrupted:
            if pace:
                pace.watch(trainer, run, progress, save=lambda: save_training(trainer, run))
            try:
                advance(trainer) if advance else trainer.advance()
            except UnreadablePhoto:
                raise
            except LinprimError as error:
                raise LinprimError(
                    f"{run.path}: training diverged at step {trainer.step} ({error}); what was saved before is intact"
                ) from None
            last = trainer.step == (until or trainer.iterations)
            score = None
            if last or (options.evaluate_every and trainer.step % options.evaluate_every == 0):
                views = held_out if last else held_out[:: max(1, len(held_out) // QUICK_VIEWS)]
                score = evaluate(trainer, views)
                score_gain = None if trainer.exposure is None else evaluate(trainer, views, gains=True)
            if trainer.step % 100 == 0 or last or score is not None:
                entry = {
                    "step": trainer.step,
                    "seconds": round(trainer.seconds, 3),
                    "loss": round(trainer.loss, 6),
                    "train_psnr": round(trainer.psnr, 3),
                    "primitives": len(trainer),
                    "memory_gib": round(memory_gib(), 3),
                }
                if score is not None:
                    entry["psnr"] = round(score, 4)
                    if score_gain is not None:
                        entry["psnr_gain"] = round(score_gain, 4)
                    progress.note(
                        f"  step {trainer.step}: held-out PSNR {score:.2f} dB, {len(trainer)} primitives, "
                        f"{duration(trainer.seconds)}"
                    )
                log.write(json.dumps(entry) + "\n")
                log.flush()
                os.fsync(log.fileno())  # so that it is on disk before the checkpoint that follows
            if last or trainer.step % options.checkpoint_every == 0:
                save_training(trainer, run)
                saved = trainer.step
            progress.update(
                trainer.step,
                f"loss {trainer.loss:.4f}  PSNR {trainer.psnr:.2f}  {len(trainer)} primitives  {memory_gib():.1f} GiB",
            )
        progress.clear()
        if (
            saved != trainer.step
        ):  # interrupted between checkpoints, or stopped after the last one and before the export
            save_training(trainer, run)
        if interrupted:
            progress.note(f"interrupted: {run.path} holds step {trainer.step}; go on with --resume")
            raise KeyboardInterrupt
    if score is None:
        score = evaluate(trainer, held_out)
        score_gain = None if trainer.exposure is None else evaluate(trainer, held_out, gains=True)
    return trainer.seconds, score, score_gain


def cut_metrics(path: Path, step: int) -> None:
    """Remove from a metrics table the lines after `step` and incomplete lines left when the run was killed."""
    if not path.exists():
        return
    kept = []
    for line in path.read_text(errors="replace").splitlines():
        try:
            if json.loads(line)["step"] <= step:
                kept.append(line + "\n")
        except (ValueError, KeyError, TypeError):
            continue
    with atomic_write(path) as temporary:
        temporary.write_text("".join(kept))


def evaluate(trainer: Trainer, images: list[TrainingImage], gains: bool = False) -> float | None:
    """Return the mean PSNR in dB over views, or None without views. Renders are clamped and rounded to 8 bits, like
    saved images.

    With `gains`, each render is first multiplied by the gain per channel that fits its photograph best, because the
    exposure of a held-out photograph is unknown.
    """
    from linprim_geo.imaging.metrics import psnr, to_8bit

    background = trainer.shown_background()
    scores = []
    for image in images:
        render, photo = trainer.render(image.camera, background).numpy(), image.over(background).numpy()
        if gains:
            alpha = None if image.alpha is None else image.alpha.numpy() / 255
            render = with_best_gain(render.transpose(1, 2, 0), photo.transpose(1, 2, 0), alpha).transpose(2, 0, 1)
        scores.append(psnr(to_8bit(render), to_8bit(photo)))
    return float(np.mean(scores)) if scores else None


@contextmanager
def _interrupt_flag() -> Iterator[list]:
    """Yield a list that becomes non-empty on the first Ctrl-C, so that the current step can finish. A second Ctrl-C
    interrupts immediately."""
    flag: list[int] = []

    def note(number, frame):
        if flag:
            raise KeyboardInterrupt
        flag.append(number)

    try:
        before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    except ValueError:  # not in the main thread: no handlers there
        before = {}
    try:
        yield flag
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def save_training(trainer: Trainer, run: Run) -> None:
    """Write a checkpoint and the exported scene. Each file replaces its predecessor only once it is complete.

    Raises:
        LinprimError: a parameter is not finite, or a file cannot be written.
    """
    for name, value in trainer.parameters.items():
        if not bool(torch.isfinite(value).all()):
            raise LinprimError(
                f"{run.path}: training diverged at step {trainer.step} ({name} is not finite); what was saved "
                "before is intact"
            )
    write_checkpoint(run.path / "checkpoints", trainer)
    run.save(
        trainer.primitives(),
        {
            "iteration": trainer.step,
            "iterations": trainer.iterations,
            "primitives": len(trainer),
            "background": [float(x) for x in trainer.shown_background()],
            "seconds": trainer.seconds,
        }
        | ({} if trainer.exposure is None else {"gains": _gains(trainer.images, trainer.exposure)}),
        trainer.environment,
    )


def _gains(images: Sequence[TrainingImage], exposure: Exposure) -> dict[str, list[float]]:
    """Return {name of a training view: its gain per channel}."""
    return {image.name: gain.tolist() for image, gain in zip(images, exposure.gains, strict=True)}
