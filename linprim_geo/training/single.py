"""Train a whole scene as one model, without blocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace

from linprim_geo.base.budget import Budget
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import GEOMETRY_WEIGHTS
from linprim_geo.base.progress import Progress, duration
from linprim_geo.capture.types import Scene
from linprim_geo.kernels import ops
from linprim_geo.points.initial_points import VolumePoints
from linprim_geo.points.start_points import SFM_START, with_points
from linprim_geo.runs.run import Run
from linprim_geo.training.budget.pacing import Pace, plan_run
from linprim_geo.training.effects import Decision
from linprim_geo.training.held_out_gap import gap_advice
from linprim_geo.training.loop import QUICK_VIEWS, evaluate, run_steps
from linprim_geo.training.start import geometry_terms, start_trainer
from linprim_geo.training.step.dropout import chosen_share
from linprim_geo.training.step.trainer import Trainer
from linprim_geo.training.step.training_images import TrainingImage, load_training_images
from linprim_geo.training.stereo_surfaces import Surfaces, stereo_surfaces


def train_run(
    run: Run,
    scene: Scene,
    state: dict | None,
    progress: Progress,
    decisions: Sequence[Decision] = (),
    budget: Budget | None = None,
    advance: Callable[[Trainer], None] | None = None,
) -> dict:
    """Train from a checkpoint's `state`, or from the start if it is None.

    Random choices depend on the step alone, so a stopped and resumed run gives the same result.

    Args:
        run: the run; the folder of a new run does not exist yet.
        decisions, budget: for a new run; stored in its config.json.
        advance: see `train`.

    Returns, raises: as `train`.
    """
    options = run.train_options
    if state is None or any(getattr(options, name) > 0 for name in (*GEOMETRY_WEIGHTS, "stereo_depth")):
        scene = with_points(scene, options, progress.note)
    images = load_training_images(scene.train, run.similarity)
    if all(image.alpha is not None and int(image.alpha.max()) == 0 for image in images):
        raise LinprimError(f"{scene.root}: the masks leave no pixel of any training image")
    held_out: list[TrainingImage] | None = None
    surfaces = Surfaces()
    if state is None or state["step"] < options.iterations:
        surfaces = stereo_surfaces(scene, options, progress, None if state else budget, started=state is not None)
    if state is None and not surfaces.maps:  # record this, so that a resumed run does not look for surfaces either
        options = replace(options, stereo_depth=0.0)
        run = replace(run, train_options=options)
    if state is None:
        options = replace(options, dropout=chosen_share(options.dropout, len(scene.train)))
        run = replace(run, train_options=options)
    pace = None
    if budget:
        held_out = load_training_images(scene.test, run.similarity)
        run, scene, pace = _planned(run, scene, images, held_out, surfaces, budget, progress)
        options, progress.total = run.train_options, run.train_options.iterations
    trainer = start_trainer(scene, run, images, options, state, surfaces=surfaces)
    trainer.terms = geometry_terms(run, scene, images, surfaces, progress)
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
    for torn in [*run.path.glob(".*.tmp*"), *run.path.glob("checkpoints/.*.tmp*")]:  # left incomplete by a kill
        torn.unlink()
    progress.note(
        f"{scene.root}: {scene.kind}, {len(scene.train)} training and {len(scene.test)} held-out views of "
        f"{images[0].camera.width}x{images[0].camera.height}; {len(trainer)} primitives, {ops.instruction_set()}, "
        f"{ops.threads()} threads; background: {_background_in_words(trainer)}"
    )
    held_out = load_training_images(scene.test, run.similarity) if held_out is None else held_out
    scene.release_photos()
    progress.restart(progress.total, trainer.step)
    seconds, score, score_gain = run_steps(trainer, run, held_out, progress, pace, advance=advance)
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
    compared = score if score_gain is None else score_gain
    if compared is not None:
        result |= _beside_training_views(trainer, run, images, compared, progress)
    if pace:
        result["time_budget"] = pace.close(run, progress)
    return result


def _background_in_words(trainer: Trainer) -> str:
    if "environment" in trainer.parameters:
        return "an environment at infinity"
    if trainer.fitted:
        return "one fitted colour, as for a plain backdrop"
    return "random colours" if trainer.random_background else "one colour"


def _planned(
    run: Run,
    scene: Scene,
    images: list[TrainingImage],
    held_out: list[TrainingImage],
    surfaces: Surfaces,
    budget: Budget,
    progress: Progress,
) -> tuple[Run, Scene, Pace]:
    """Return the run with options that fit the time budget, and the scene with initial points for that number of
    primitives."""
    volume = isinstance(scene.points, VolumePoints)
    planned, pace = plan_run(
        run,
        images,
        held_out,
        geometry_terms(run, scene, images, surfaces, progress),
        budget,
        progress,
        start=lambda options: start_trainer(scene, run, images, options, None, surfaces=surfaces),
        score=evaluate,
        # A smaller limit on primitives leaves too many points rather than too few; random points in a volume are drawn
        # anew below.
        start_share=0.0 if volume else SFM_START,
        quick_views=len(held_out[:: max(1, len(held_out) // QUICK_VIEWS)]),
    )
    if volume:  # as many points as initial primitives
        scene = with_points(replace(scene, points=None), planned.train_options, progress.note)
    return planned, scene, pace


def _beside_training_views(
    trainer: Trainer, run: Run, images: Sequence[TrainingImage], score: float, progress: Progress
) -> dict:
    """Return the mean PSNR of some training views, and advice if the held-out `score` is far below it.

    Where exposures are fitted, each render is first multiplied by its best gain.
    """
    some = list(images[:: max(1, len(images) // QUICK_VIEWS)])
    train_score = evaluate(trainer, some, gains=trainer.exposure is not None)
    assert train_score is not None
    found: dict = {"train_psnr": train_score}
    effects = run.notes.get("effects")
    decided = effects if isinstance(effects, list) else []
    if advice := gap_advice(train_score, score, len(images), trainer.options, decided):
        progress.note(advice)
        found["advice"] = advice
        run.note("advice", advice)
    return found
