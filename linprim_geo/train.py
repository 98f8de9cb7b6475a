"""Training: photographs and a first guess of primitives in, a run folder with optimised primitives out.

One view per step (trainer.py): render, L1 + D-SSIM, Adam, and now and then the population grows (population.py). This file is
what surrounds the steps: where to start, scores on held-out views, checkpoints, interruption, resuming.
"""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, fields, replace
from pathlib import Path

import numpy as np
import torch

from . import ops
from .camera import Similarity
from .checkpoint import read_checkpoint, restore, write_checkpoint
from .effects import Choice, Decision, decide, settle, summary
from .errors import LinprimError
from .evidence import observe
from .exposure import Exposure, with_best_gain
from .files import atomic_write, is_remains, locked, writing
from .fill_points import fill_points
from .geometry_terms import GeometryTerms, gather_evidence
from .initial_points import (
    CAMERA_DISTANCE,
    VolumePoints,
    frusta_points,
    local_planes,
    scene_normalization,
    visual_hull_points,
)
from .options import GEOMETRY_WEIGHTS, SceneOptions, TrainOptions, check_train_options, initial_count
from .pacing import Pace, plan_run
from .primitives import KINDS
from .progress import Progress, duration, memory_gib
from .run import Run, is_unused, refuse_used
from .scene import PointCloud, Scene, load_scene
from .shots import Shot, UnreadablePhoto, load_shots
from .structure_from_motion import prepare
from .time_budget import Budget
from .trainer import LARGEST_PART, SMALLEST_PX, Trainer, initial_parameters

# Primitives at the start, as a share of the most there may be: from points on surfaces, and from random ones.
SFM_START, RANDOM_START = 0.8, 0.25
# Triangulated points fewer than this leave too much of a scene empty.
FEW_POINTS = 500
# A backdrop is plain where this share of all border pixels lies this near to their median colour, per channel.
BACKDROP_SHARE, BACKDROP_TOLERANCE = 0.8, 0.1
# Held-out views scored during training; all of them are at the end.
QUICK_VIEWS = 16


def with_points(scene: Scene, options: TrainOptions, log: Callable[[str], None]) -> Scene:
    """The scene with points to start from: its own, triangulated under the known poses, or random where cameras look.

    A scene with alpha and no points starts inside the visual hull. Without alpha, features are matched and triangulated; if they
    are few, random points in the common field of view fill up.
    """
    from .triangulate import triangulate_points

    if scene.points is not None and len(scene.points.xyz):
        return scene
    count = initial_count(options, RANDOM_START)
    if scene.has_alpha:
        return replace(scene, points=visual_hull_points(scene, count, options.seed))
    try:
        cloud = triangulate_points(scene, seed=options.seed, log=log)
    except LinprimError as error:
        log(f"no points could be triangulated ({error}); starting from random ones")
        return replace(scene, points=frusta_points(scene, count, options.seed))
    if len(cloud.xyz) < min(FEW_POINTS, count):
        extra = frusta_points(scene, count - len(cloud.xyz), options.seed)
        cloud = VolumePoints(np.concatenate([cloud.xyz, extra.xyz]), np.concatenate([cloud.rgb, extra.rgb]))
    return replace(scene, points=cloud)


def initial_cloud(cloud: PointCloud, options: TrainOptions) -> PointCloud:
    """At most as many of the points as the population starts with, drawn without replacement."""
    count = initial_count(options, SFM_START)
    if len(cloud.xyz) <= count:
        return cloud
    keep = np.sort(np.random.default_rng([options.seed, 1]).choice(len(cloud.xyz), count, replace=False))
    return PointCloud(cloud.xyz[keep], cloud.rgb[keep])


def decided_scene(
    path: Path, scene_options: SceneOptions, options: TrainOptions, choice: Choice, log: Callable[[str], None]
) -> tuple[list[Decision], Scene, SceneOptions, TrainOptions]:
    """Reads a scene, decides about its effects, and reads it again if that changes how.

    Returns: the decisions, the scene with points to start from, and both options with what was decided put in.
    """

    def read(how: SceneOptions) -> Scene:
        loaded = load_scene(
            path,
            downscale=how.downscale,
            masks=how.masks or None,
            images=how.images or None,
            sparse=how.sparse or None,
            frames=how.frames,
            pinhole_below=how.pinhole_below,
        ).with_training_views(how.views)
        return with_points(loaded, options, log)

    if scene_options.views < 0:
        raise LinprimError(f"--views is {scene_options.views}, wanted a number of training views, or 0 for all")
    prepare(path, scene_options.sparse or None, scene_options.frames, threads=options.threads, log=log)
    scene = read(scene_options)
    if choice.mode == "none" and not choice.asked:
        return [], scene, scene_options, options
    decisions = decide(scene, scene_options, options, choice)
    settled, options = settle(scene_options, options, decisions)
    check_train_options(options)
    distorted = any(view.lens is not None for view in scene.views)
    if replace(settled, pinhole_below=scene_options.pinhole_below) != scene_options or (
        distorted and settled.pinhole_below != scene_options.pinhole_below
    ):
        scene = read(settled)
    return decisions, scene, settled, options


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

    With `resume` the folder's own options are used (but for `threads`): learning rates and growth depend on them. A capture that is no
    longer where it was is looked for at `scene`. Interrupted (Ctrl-C), it finishes the step, saves, and raises KeyboardInterrupt.

    With `time_budget`, in seconds from now for everything, a calibration of some dozen steps says what a step costs, and
    `time_budget.plan_training` chooses `iterations` and `max_primitives` from it; one of the two that differs from its default is
    kept. When growth has ended the steps that are left are counted anew, once, from the pace so far. Both are in config.json under
    `time_budget`, so that a resumed run repeats them, with the seconds that the run took.

    With `effects` the options that the scene calls for take the place of those that were not given (effects.py); without, all are taken as
    they are. What was decided is in config.json, and a resumed run keeps it.

    With `blocks` other than 1 the scene is trained in blocks of space by several workers, see `block_training.train_blocks`.

    Returns: `run`, `iterations`, `seconds` (of training steps alone), `primitives`, `psnr` (mean over held-out views), `views`; with
    `--exposure gain` also `psnr_gain`, each render times the gain per channel that brings it nearest to its photograph.

    Raises:
        LinprimError: the scene or an option cannot be used, or the folder exists already.
    """
    run_path = Path(run)
    if blocks != 1 or (resume and "blocks" in _notes(run_path)):
        from .block_training import train_blocks

        if time_budget:
            raise LinprimError("--time-budget plans one training: wanted without --blocks")
        return train_blocks(
            scene, run, scene_options, options,
            blocks=blocks, cluster=cluster, workers=workers, resume=resume, quiet=quiet, effects=effects,
        )  # fmt: skip
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
    if budget and all(getattr(options, name) != getattr(TrainOptions, name) for name in ("iterations", "max_primitives")):
        raise LinprimError("--time-budget leaves nothing to choose beside --iterations and --max-primitives: wanted at most one of the two")
    try:
        # torch only does small element-wise work here; its own threads would wait for each other longer than they compute.
        torch.set_num_threads(1)
        with locked(run_path, "trained into"):
            ops.set_threads(options.threads)
            if resume:
                opened, loaded = _reopen(Path(scene), run_path, scene_options, options, progress)
                return _train(opened, loaded, read_checkpoint(run_path), progress)
            opened, loaded, decisions = _begin(
                Path(scene), run_path, scene_options, options, effects or Choice("none"), progress
            )
            return _train(opened, loaded, None, progress, decisions, budget)
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


def _begin(
    scene: Path,
    run_path: Path,
    scene_options: SceneOptions,
    options: TrainOptions,
    effects: Choice,
    progress: Progress,
) -> tuple[Run, Scene, list[Decision]]:
    """A new run, whose folder is not made yet, its scene with points to start from, and what was decided about its effects."""
    refuse_used(run_path)
    decisions, loaded, scene_options, options = decided_scene(scene, scene_options, options, effects, progress.note)
    if decisions:
        progress.note(summary(decisions))
    run = Run(run_path, scene, scene_options, options, scene_normalization(loaded), loaded.unit)
    return run, loaded, decisions


def _reopen(
    scene: Path, run_path: Path, scene_options: SceneOptions, options: TrainOptions, progress: Progress
) -> tuple[Run, Scene]:
    """An existing run and its scene; options that were given and differ from the run's are named as ignored."""
    opened = Run.open(run_path)
    if scene.resolve() != opened.scene_path:
        opened = opened.with_scene_at(scene)
    ignored = [
        "--" + field.name.replace("_", "-")
        for given, own in ((scene_options, opened.scene_options), (options, opened.train_options))
        for field in fields(given)
        if field.name != "threads"
        and getattr(given, field.name) not in (field.default, getattr(own, field.name))
    ]
    if ignored:
        progress.note(f"--resume goes on with the run's own options: {', '.join(ignored)} ignored")
    if opened.instruction_set not in ("", ops.instruction_set()):
        progress.note(
            f"begun with {opened.instruction_set} kernels and going on with {ops.instruction_set()}: the last bits will differ"
        )
    progress.total = opened.train_options.iterations
    return replace(
        opened, train_options=replace(opened.train_options, threads=options.threads)
    ), opened.scene()


def _train(
    run: Run,
    scene: Scene,
    state: dict | None,
    progress: Progress,
    decisions: Sequence[Decision] = (),
    budget: Budget | None = None,
) -> dict:
    """Trains from a checkpoint's `state`, or from the start: what is random does not depend on when a run was stopped."""
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
            _terms(run, scene, shots, progress),
            budget,
            progress,
            start=lambda options: _start(scene, run, shots, options, None),
            score=evaluate,
            # The smaller limit that is chosen leaves too many points, not too few, and volumes are filled anew.
            start_share=0.0 if volume else SFM_START,
            quick_views=len(held_out[:: max(1, len(held_out) // QUICK_VIEWS)]),
        )
        options, progress.total = run.train_options, run.train_options.iterations
        if volume:  # as many as the population begins with
            scene = with_points(replace(scene, points=None), options, progress.note)
    trainer = _start(scene, run, shots, options, state)
    trainer.terms = _terms(run, scene, shots, progress)
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
        f"{shots[0].camera.width}x{shots[0].camera.height}; {len(trainer)} primitives, {ops.instruction_set()}, {ops.threads()} threads"
    )
    held_out = load_shots(scene.test, run.similarity) if held_out is None else held_out
    seconds, score, score_gain = _loop(trainer, run, held_out, progress, pace)
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
    if pace:
        result["time_budget"] = pace.close(run, progress)
    return result


def _terms(run: Run, scene: Scene, shots: list[Shot], progress: Progress) -> GeometryTerms | None:
    """The late terms for geometry that have a weight, None if none has."""
    options = run.train_options
    if not any(getattr(options, name) > 0 for name in GEOMETRY_WEIGHTS):
        return None
    assert scene.points is not None
    evidence = gather_evidence(scene, options, run.similarity, progress.note)
    terms = GeometryTerms(options, shots, evidence, run.similarity.apply(scene.points.xyz))
    if terms.sources is not None and not any(terms.sources):
        progress.note("--patches: no two views see the same places from angles that suit it, so it does nothing")
    return terms


def _background(text: str, shots: list[Shot]) -> tuple[torch.Tensor, bool, bool]:
    """(colour that renders show, whether it is fitted, whether training draws a random one) of the option's text.

    Without alpha a random background makes everything opaque: a fitted one would let a wall of its colour become transparent. It is
    fitted only where photographs have a plain backdrop.
    """
    named = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
    has_alpha = shots[0].alpha is not None
    if text == "auto":
        text = "fitted" if not has_alpha and plain_border(shots) > BACKDROP_SHARE else "random"
    if text == "random":
        shown = torch.ones(3) if has_alpha else torch.from_numpy(_mean_color(shots))
        return shown, False, True
    if text == "fitted":
        return torch.from_numpy(np.median(_border_colors(shots), 0).astype(np.float32)), True, False
    try:
        color = named[text] if text in named else tuple(float(x) for x in text.split(","))
    except ValueError:
        color = ()
    if len(color) != 3 or not all(0 <= x <= 1 for x in color):
        raise LinprimError(
            f"--background is {text!r}, wanted auto, fitted, random, black, white, or three numbers in [0,1] such as 0.5,0.5,1"
        )
    return torch.tensor(color, dtype=torch.float32), False, False


def _border_colors(shots: list[Shot]) -> np.ndarray:
    """(P, 3) colours in [0, 1] of the outermost pixels of all views."""
    edges = []
    for rgb in (shot.rgb.numpy() for shot in shots):
        edges.append(np.concatenate([edge.T for edge in (rgb[:, 0], rgb[:, -1], rgb[:, :, 0], rgb[:, :, -1])]))
    return np.concatenate(edges).astype(np.float64) / 255


def plain_border(shots: list[Shot]) -> float:
    """Share of the outermost pixels of all views that lie near their median colour."""
    colors = _border_colors(shots)
    return float(np.mean(np.abs(colors - np.median(colors, 0)).max(1) < BACKDROP_TOLERANCE))


def _mean_color(shots: list[Shot]) -> np.ndarray:
    return np.mean([s.rgb.numpy().mean((1, 2)) for s in shots], 0).astype(np.float32) / np.float32(255)


def _start(
    scene: Scene,
    run: Run,
    shots: list[Shot],
    options: TrainOptions,
    state: dict | None,
    region: Callable[[PointCloud], PointCloud] | None = None,
) -> Trainer:
    """A trainer at step 0, or at the step of a checkpoint's `state`. `region` leaves of the points to start from what is to be trained."""
    focal = float(np.median([max(s.camera.fx, s.camera.fy) for s in shots]))
    centers = np.stack([s.camera.center for s in shots])
    background, fitted, random_background = _background(options.background, shots)
    surface = state is None and not isinstance(scene.points, VolumePoints)
    if state is not None:
        xyz, rgb, radius = np.zeros((4, 3)), np.zeros((4, 3)), 1.0  # replaced below
    else:
        assert scene.points is not None
        backdrop = background.numpy() if fitted else None
        cloud = fill_points(scene, options.seed, backdrop) if surface else scene.points
        cloud = initial_cloud(cloud if region is None else region(cloud), options)
        xyz, rgb = run.similarity.apply(cloud.xyz), cloud.rgb
        middle = np.median(xyz, 0)
        reach = np.linalg.norm(xyz - middle, axis=1)
        radius = max(
            float(np.percentile(reach, 98)), 0.2 * float(np.linalg.norm(centers - middle, axis=1).max()), 1e-3
        )
    smallest = SMALLEST_PX * CAMERA_DISTANCE / focal
    like = KINDS[options.primitive].size
    bounds = (like * smallest, like * max(LARGEST_PART * radius, 4 * smallest))
    parameters = initial_parameters(xyz, rgb, options.sh_degree, options.seed, bounds, options.primitive)
    if surface and parameters["log_extent"].shape[1] == 3:
        _lay_down(parameters, xyz, options.seed, bounds[0])
    log_gain = None
    if options.exposure == "gain" and state is None:
        seen = observe(scene, options.seed, views=len(shots))
        log_gain = None if seen is None else seen.log_gains[0]
    trainer = Trainer(shots, parameters, options, bounds, background, fitted, random_background, log_gain=log_gain)
    if state is not None:
        restore(trainer, state, run.path / "checkpoints")
    return trainer


def _lay_down(parameters: dict[str, torch.Tensor], xyz: np.ndarray, seed: int, smallest: float) -> None:
    """Lays primitives on the planes of their points, as thin across as these are flat, at least twice the smallest extent.

    A ball round a point of a plain wall stands out from it by its radius, and no photograph says that it does not.
    """
    rotation, flat = local_planes(xyz, seed)
    parameters["rotation"].copy_(torch.from_numpy(rotation))
    across = parameters["log_extent"][:, 2]
    thin = across + torch.from_numpy(np.log(flat)).float()
    across.copy_(torch.maximum(thin, across.clamp_max(float(np.log(2 * smallest)))))


def _loop(
    trainer: Trainer, run: Run, held_out: list[Shot], progress: Progress, pace: Pace | None = None
) -> tuple[float, float | None, float | None]:
    """Steps until the end; returns the seconds spent in steps, and the final held-out PSNR as rendered and with gains."""
    options = trainer.options
    table = run.path / "metrics.jsonl"
    _cut_metrics(table, trainer.step)
    score = score_gain = None
    saved = -1
    with writing(table), open(table, "a") as log, _interrupt_flag() as interrupted:
        while trainer.step < trainer.iterations and not interrupted:
            if pace:
                pace.watch(trainer, run, progress, save=lambda: _save(trainer, run))
            try:
                trainer.advance()
            except UnreadablePhoto:
                raise
            except LinprimError as error:
                raise LinprimError(
                    f"{run.path}: training diverged at step {trainer.step} ({error}); what was saved before is intact"
                ) from None
            last = trainer.step == trainer.iterations
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
                        f"  step {trainer.step}: held-out PSNR {score:.2f} dB, {len(trainer)} primitives, {duration(trainer.seconds)}"
                    )
                log.write(json.dumps(entry) + "\n")
                log.flush()
                os.fsync(log.fileno())  # before the checkpoint that follows it
            if last or trainer.step % options.checkpoint_every == 0:
                _save(trainer, run)
                saved = trainer.step
            progress.update(
                trainer.step,
                f"loss {trainer.loss:.4f}  PSNR {trainer.psnr:.2f}  {len(trainer)} primitives  {memory_gib():.1f} GiB",
            )
        progress.clear()
        if (
            saved != trainer.step
        ):  # interrupted between checkpoints, or stopped after the last one and before the export
            _save(trainer, run)
        if interrupted:
            progress.note(f"interrupted: {run.path} holds step {trainer.step}; go on with --resume")
            raise KeyboardInterrupt
    if score is None:
        score = evaluate(trainer, held_out)
        score_gain = None if trainer.exposure is None else evaluate(trainer, held_out, gains=True)
    return trainer.seconds, score, score_gain


def _cut_metrics(path: Path, step: int) -> None:
    """Drops lines after `step`, and one that was torn when the run was killed."""
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


def evaluate(trainer: Trainer, shots: list[Shot], gains: bool = False) -> float | None:
    """Mean PSNR over views, renders clamped and rounded to 8 bits as saved images are; None without views.

    With `gains` each render is first multiplied by the gain per channel that brings it nearest to its photograph: what a photograph of
    unknown exposure can say about it.
    """
    from .eval.images import psnr, to_8bit

    background = trainer.shown_background()
    scores = []
    for shot in shots:
        render, photo = trainer.render(shot.camera, background).numpy(), shot.over(background).numpy()
        if gains:
            alpha = None if shot.alpha is None else shot.alpha.numpy() / 255
            render = with_best_gain(render.transpose(1, 2, 0), photo.transpose(1, 2, 0), alpha).transpose(2, 0, 1)
        scores.append(psnr(to_8bit(render), to_8bit(photo)))
    return float(np.mean(scores)) if scores else None


@contextmanager
def _interrupt_flag() -> Iterator[list]:
    """A list that becomes non-empty on the first Ctrl-C, so that a step is never torn; a second one interrupts at once."""
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


def _save(trainer: Trainer, run: Run) -> None:
    """Writes a checkpoint and the exported scene; every file replaces its predecessor only when it is complete."""
    for name, value in trainer.parameters.items():
        if not bool(torch.isfinite(value).all()):
            raise LinprimError(
                f"{run.path}: training diverged at step {trainer.step} ({name} is not finite); what was saved before is intact"
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
        | ({} if trainer.exposure is None else {"gains": _gains(trainer.shots, trainer.exposure)}),
    )


def _gains(shots: Sequence[Shot], exposure: Exposure) -> dict[str, list[float]]:
    """{name of a training view: its gain per channel}."""
    return {shot.name: gain.tolist() for shot, gain in zip(shots, exposure.gains, strict=True)}
