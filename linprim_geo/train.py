"""Training: photographs and a first guess of primitives in, a run folder with optimised primitives out.

One view per step (trainer.py): render, L1 + D-SSIM, Adam, and now and then the population grows (population.py). This file is
what surrounds the steps: where to start, scores on held-out views, checkpoints, interruption, resuming.
"""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import torch

from . import ops
from .errors import LinprimError
from .files import atomic_write
from .options import SceneOptions, TrainOptions, check_train_options
from .progress import Progress, duration, memory_gib
from .run import Run
from .scene import PointCloud, Scene, load_scene
from .trainer import LARGEST_PART, SMALLEST_PX, Shot, Trainer, initial_parameters, load_shots

# Primitives at the start, as a share of the most there may be: from points on surfaces, and from random ones.
SFM_START, RANDOM_START = 0.8, 0.25
# Triangulated points fewer than this leave too much of a scene empty.
FEW_POINTS = 500
# Held-out views scored during training; all of them are at the end.
QUICK_VIEWS = 16
KEPT_CHECKPOINTS = 2


def with_points(scene: Scene, options: TrainOptions, log: Callable[[str], None]) -> Scene:
    """The scene with points to start from: its own, triangulated under the known poses, or random where cameras look.

    A scene with alpha and no points starts inside the visual hull. Without alpha, features are matched and triangulated; if they
    are few, random points in the common field of view fill up.
    """
    from .initial_points import frusta_points, visual_hull_points
    from .triangulate import triangulate_points

    if scene.points is not None and len(scene.points.xyz):
        return scene
    count = _initial_count(options, RANDOM_START)
    if scene.has_alpha:
        return replace(scene, points=visual_hull_points(scene, count, options.seed))
    try:
        cloud = triangulate_points(scene, seed=options.seed, log=log)
    except LinprimError as error:
        log(f"no points could be triangulated ({error}); starting from random ones")
        return replace(scene, points=frusta_points(scene, count, options.seed))
    if len(cloud.xyz) < min(FEW_POINTS, count):
        extra = frusta_points(scene, count - len(cloud.xyz), options.seed)
        cloud = PointCloud(np.concatenate([cloud.xyz, extra.xyz]), np.concatenate([cloud.rgb, extra.rgb]))
    return replace(scene, points=cloud)


def initial_cloud(cloud: PointCloud, options: TrainOptions) -> PointCloud:
    """At most as many of the points as the population starts with, drawn without replacement."""
    count = _initial_count(options, SFM_START)
    if len(cloud.xyz) <= count:
        return cloud
    keep = np.sort(np.random.default_rng([options.seed, 1]).choice(len(cloud.xyz), count, replace=False))
    return PointCloud(cloud.xyz[keep], cloud.rgb[keep])


def _initial_count(options: TrainOptions, share: float) -> int:
    return min(
        options.max_primitives, options.initial_primitives or max(500, round(share * options.max_primitives))
    )


def train(
    scene: str | os.PathLike,
    run: str | os.PathLike,
    scene_options: SceneOptions | None = None,
    options: TrainOptions | None = None,
    *,
    resume: bool = False,
    quiet: bool = False,
) -> dict:
    """Trains a scene into a run folder.

    With `resume` the folder's own options are used (but for `threads`): learning rates and growth depend on them. Interrupted
    (Ctrl-C), it finishes the step, saves, and raises KeyboardInterrupt.

    Returns: `run`, `iterations`, `seconds` (of training steps alone), `primitives`, `psnr` (mean over held-out views), `views`.

    Raises:
        LinprimError: the scene or an option cannot be used, or the folder exists already.
    """
    from .initial_points import scene_normalization

    run_path = Path(run)
    check_train_options(options := options or TrainOptions())
    progress = Progress("train", options.iterations, quiet=quiet)
    if resume:
        opened = Run.open(run_path)
        if Path(scene).resolve() != opened.scene_path:
            raise LinprimError(
                f"{run_path}: was trained on {opened.scene_path}, not on {Path(scene).resolve()}"
            )
        ignored = [
            f.name
            for f in fields(options)
            if getattr(options, f.name) not in (f.default, getattr(opened.train_options, f.name))
        ]
        if set(ignored) - {"threads"}:
            progress.note(
                f"--resume goes on with the run's own options: {', '.join(sorted(set(ignored) - {'threads'}))} ignored"
            )
        options = replace(opened.train_options, threads=options.threads)
        progress.total = options.iterations
        loaded = opened.scene()
    else:
        scene_options = scene_options or SceneOptions()
        loaded = load_scene(
            scene,
            downscale=scene_options.downscale,
            masks=scene_options.masks or None,
            sparse=scene_options.sparse or None,
        )
        if run_path.exists() and (not run_path.is_dir() or any(run_path.iterdir())):
            raise LinprimError(
                f"{run_path}: exists already; give another folder with -o, or go on with --resume"
            )
        _threads(options)
        loaded = with_points(loaded, options, progress.note)
        opened = Run(run_path, Path(scene), scene_options, options, scene_normalization(loaded), loaded.unit)
    _threads(options)
    shots = load_shots(loaded.train, opened.similarity)
    if all(shot.alpha is not None and int(shot.alpha.max()) == 0 for shot in shots):
        raise LinprimError(f"{loaded.root}: the masks leave no pixel of any training image")
    # A run that was stopped before its first checkpoint begins again: nothing random depends on when.
    resume_state = _read_checkpoint(run_path) if resume else None
    if resume and resume_state is None:
        _threads(options)
        loaded = with_points(loaded, options, progress.note)
    trainer = _start(loaded, opened, shots, options, resume_state)
    if not resume:
        Run.create(run_path, loaded, Path(scene), scene_options, options, opened.similarity)
    progress.start = trainer.step
    progress.note(
        f"{loaded.root}: {loaded.kind}, {len(loaded.train)} training and {len(loaded.test)} held-out views of "
        f"{shots[0].camera.width}x{shots[0].camera.height}; {len(trainer)} primitives, {ops.instruction_set()}, {ops.threads()} threads"
    )
    held_out = load_shots(loaded.test, opened.similarity)
    seconds, score = _loop(trainer, opened, held_out, progress)
    result = {
        "run": str(run_path),
        "iterations": trainer.step,
        "seconds": seconds,
        "primitives": len(trainer),
        "psnr": score,
        "views": len(held_out),
    }
    progress.note(
        f"{run_path}: {trainer.step} steps in {duration(seconds)}, {len(trainer)} primitives"
        + (f", held-out PSNR {score:.2f} dB over {len(held_out)} views" if held_out else "")
    )
    return result


def _threads(options: TrainOptions) -> None:
    ops.set_threads(options.threads)
    # torch only does small element-wise work here; its own threads would wait for each other longer than they compute.
    torch.set_num_threads(1)


def _background(text: str, has_alpha: bool) -> tuple[torch.Tensor, bool, bool]:
    """(colour, whether it is fitted, whether training draws a random one) of the option's text."""
    named = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
    if text == "auto":
        text = "random" if has_alpha else "fitted"
    if text == "random":
        if not has_alpha:
            raise LinprimError(
                "--background random needs images with an alpha channel or masks; this scene has none"
            )
        return torch.ones(3), False, True
    if text == "fitted":
        return torch.full((3,), 0.5), True, False
    try:
        color = named[text] if text in named else tuple(float(x) for x in text.split(","))
    except ValueError:
        color = ()
    if len(color) != 3 or not all(0 <= x <= 1 for x in color):
        raise LinprimError(
            f"--background is {text!r}, wanted auto, fitted, random, black, white, or three numbers in [0,1] such as 0.5,0.5,1"
        )
    return torch.tensor(color, dtype=torch.float32), False, False


def _start(scene: Scene, run: Run, shots: list[Shot], options: TrainOptions, state: dict | None) -> Trainer:
    """A trainer at step 0, or at the step of a checkpoint's `state`."""
    focal = float(np.median([max(s.camera.fx, s.camera.fy) for s in shots]))
    centers = np.stack([s.camera.center for s in shots])
    if state is not None:
        xyz, rgb, radius = np.zeros((4, 3)), np.zeros((4, 3)), 1.0  # replaced below
    else:
        cloud = initial_cloud(scene.points, options)
        xyz, rgb = run.similarity.apply(cloud.xyz), cloud.rgb
        middle = np.median(xyz, 0)
        reach = np.linalg.norm(xyz - middle, axis=1)
        radius = max(
            float(np.percentile(reach, 98)), 0.2 * float(np.linalg.norm(centers - middle, axis=1).max()), 1e-3
        )
    smallest = SMALLEST_PX * 3.0 / focal
    bounds = (smallest, max(LARGEST_PART * radius, 4 * smallest))
    background, fitted, random_background = _background(options.background, scene.has_alpha)
    parameters = initial_parameters(xyz, rgb, options.sh_degree, options.seed, bounds)
    trainer = Trainer(shots, parameters, options, bounds, background, fitted, random_background)
    if state is not None:
        try:
            trainer.restore(state)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise LinprimError(
                f"{run.path / 'checkpoints'}: the latest checkpoint lacks what a run needs ({error})"
            ) from None
    return trainer


def _loop(trainer: Trainer, run: Run, held_out: list[Shot], progress: Progress) -> tuple[float, float | None]:
    """Steps until the end; returns the seconds spent in steps and the final held-out PSNR."""
    options = trainer.options
    _cut_metrics(run.path / "metrics.jsonl", trainer.step)
    score, saved = None, -1
    with open(run.path / "metrics.jsonl", "a") as log, _interrupt_flag() as interrupted:
        while trainer.step < options.iterations and not interrupted:
            try:
                trainer.advance()
            except LinprimError as error:
                raise LinprimError(
                    f"{run.path}: training diverged at step {trainer.step} ({error}); what was saved before is intact"
                ) from None
            last = trainer.step == options.iterations
            score = None
            if last or (options.evaluate_every and trainer.step % options.evaluate_every == 0):
                score = evaluate(
                    trainer, held_out if last else held_out[:: max(1, len(held_out) // QUICK_VIEWS)]
                )
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
                    progress.note(
                        f"  step {trainer.step}: held-out PSNR {score:.2f} dB, {len(trainer)} primitives, {duration(trainer.seconds)}"
                    )
                log.write(json.dumps(entry) + "\n")
                log.flush()
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
    return trainer.seconds, evaluate(trainer, held_out) if score is None else score


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


def evaluate(trainer: Trainer, shots: list[Shot]) -> float | None:
    """Mean PSNR over views, renders clamped and rounded to 8 bits as saved images are; None without views."""
    from .eval.images import psnr, to_8bit

    background = trainer.shown_background()
    scores = [
        psnr(to_8bit(trainer.render(shot.camera, background).numpy()), to_8bit(shot.over(background).numpy()))
        for shot in shots
    ]
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
    folder = run.path / "checkpoints"
    name = f"step_{trainer.step:06d}.pt"
    with atomic_write(folder / name) as temporary:
        torch.save(trainer.state(), temporary)
    with atomic_write(folder / "latest") as temporary:
        temporary.write_text(name + "\n")
    for old in sorted(folder.glob("step_*.pt"))[:-KEPT_CHECKPOINTS]:
        old.unlink()
    run.save(
        trainer.octahedra(),
        {
            "iteration": trainer.step,
            "iterations": trainer.options.iterations,
            "primitives": len(trainer),
            "background": [float(x) for x in trainer.shown_background()],
            "seconds": trainer.seconds,
        },
    )


def _read_checkpoint(path: Path) -> dict | None:
    """The latest checkpoint of a run, None where it has none yet."""
    folder = path / "checkpoints"
    try:
        name = (folder / "latest").read_text().strip()
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise LinprimError(f"{folder / 'latest'}: cannot be read ({error})") from None
    if not name or Path(name).name != name:
        raise LinprimError(f"{folder / 'latest'}: names {name!r}, wanted a checkpoint in this folder")
    try:
        state = torch.load(folder / name, weights_only=True)
    except FileNotFoundError:
        raise LinprimError(f"{folder / name}: the latest checkpoint is missing") from None
    except Exception as error:  # torch raises many kinds for a damaged file
        raise LinprimError(
            f"{folder / name}: is damaged and cannot be read ({type(error).__name__})"
        ) from None
    if not isinstance(state, dict):
        raise LinprimError(f"{folder / name}: holds no checkpoint")
    return state
