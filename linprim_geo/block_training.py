"""Training a scene in blocks: the whole of it coarsely, a plan, every block before what the coarse scene shows of the rest, and one run
of all.

RUN/blocks holds `points.npz` (what the scene starts from), `coarse`, `plan`, and `000`, `001`, ... with a run in each, and the markers of
what is done. The result, in RUN itself, is like that of any training, but has no checkpoint.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from . import ops, worker
from .block_shots import block_shots, small_depths
from .blocks import Block, margin_of, point_work, shown, split_space, window
from .checkpoint import read_checkpoint
from .dry_run import memory_estimate
from .effects import Choice
from .errors import LinprimError
from .executor import Executor, Task, open_executor
from .files import atomic_write, locked
from .initial_points import VolumePoints
from .options import GEOMETRY_WEIGHTS, SceneOptions, TrainOptions, check_train_options
from .primitives import ARRAYS, Primitives
from .progress import Progress, duration
from .run import Run, is_unused
from .scene import PointCloud, Scene, View
from .shots import load_shots, photo_bytes
from .train import train, train_run
from .trainer import Trainer
from .training_loop import run_steps
from .training_start import begin_run, chosen_background, reopen_run, start_trainer, with_points

FOLDER = "blocks"
# The coarse scene: pixels averaged, parts of the steps and of the primitives of the whole, and the most of these and of the views.
COARSE_DOWNSCALE, COARSE_STEPS, COARSE_PRIMITIVES = 2, 0.25, 0.25
MOST_COARSE_PRIMITIVES, MOST_COARSE_VIEWS, LEAST_SIDE = 20_000, 1000, 32
# Steps of a block at least, as far as the whole has so many.
LEAST_STEPS = 300
# What margins, and pixels that show several blocks, add to a block's part of the whole, for the choice of their number.
OVERLAP = 1.5
REMEDY = "more blocks (--blocks), fewer --max-primitives, a larger --downscale, fewer --workers, or more memory"


def train_blocks(
    scene: str | os.PathLike,
    run: str | os.PathLike,
    scene_options: SceneOptions | None = None,
    options: TrainOptions | None = None,
    *,
    blocks: int | str = "auto",
    cluster: str | None = None,
    workers: int = 0,
    resume: bool = False,
    quiet: bool = False,
    effects: Choice | None = None,
) -> dict:
    """Trains a scene in blocks of space into a run folder; with a single block this is `train`.

    The steps and primitives of `options` are those of the whole: a block's cameras are those that show it, each as often as in a training
    of the whole, and it has its part of the primitives.

    Args:
        blocks: how many; "auto": as few as a worker's memory allows.
        cluster, workers: where and how many at once, see `executor.open_executor`.

    Returns: as `train`, and `blocks`, `block_peak_gib` (the most memory that a worker took), `coarse_seconds` and `worker_seconds`.

    Raises:
        LinprimError: as `train`; a block that no camera sees; an option that belongs to the whole scene; what `executor` raises.
    """
    run_path, where = Path(run).resolve(), Path(scene)
    check_train_options(options := options or TrainOptions())
    scene_options = scene_options or SceneOptions()
    check_options(options, blocks)
    progress = Progress("blocks", 1, quiet=quiet)
    before = torch.get_num_threads()
    resume = resume and not is_unused(run_path)
    try:
        torch.set_num_threads(1)
        with locked(run_path, "trained into"):
            ops.set_threads(options.threads)
            if resume:
                opened, loaded = reopen_run(where, run_path, scene_options, options, progress)
                count: int | None = opened.notes.get("blocks")
                if type(count) is not int or count < 2:
                    raise LinprimError(f"{run_path}: was not begun in blocks, wanted --resume without --blocks")
                loaded = with_points(loaded, opened.train_options, progress.note)
            else:
                opened, loaded, decisions = begin_run(where, run_path, scene_options, options, effects or Choice("none"), progress)
                check_options(opened.train_options, blocks)
                loaded = with_points(loaded, opened.train_options, progress.note)
                count = None if blocks == "auto" else int(blocks)
            if count is None:
                with TemporaryDirectory(prefix="linprim_geo_") as folder, open_executor(cluster, Path(folder), workers) as executor:
                    count = blocks_that_fit(loaded.train, opened.train_options, executor)
            if count > 1:
                if not resume:
                    notes = opened.scene_path, opened.scene_options, opened.train_options, opened.similarity, ops.instruction_set()
                    Run.create(run_path, loaded, *notes, [asdict(decision) for decision in decisions], blocks=count)
                assert loaded.points is not None
                save_points(run_path / FOLDER / "points.npz", loaded.points)
                with open_executor(cluster, run_path / FOLDER, workers) as executor:
                    return _all(replace(opened, path=run_path), loaded, count, executor, progress)
    finally:
        torch.set_num_threads(before)
    progress.note("one block holds it all")
    return train(scene, run, scene_options, options, quiet=quiet, effects=effects)


def check_options(options: TrainOptions, blocks: int | str) -> None:
    """Raises LinprimError for what blocks cannot do."""
    if blocks != "auto" and not 1 <= int(blocks) <= 10**6:
        raise LinprimError(f"--blocks is {blocks}, wanted auto, or a number from 1")
    if options.exposure != "none":
        raise LinprimError("--exposure gain is fitted over all photographs at once: wanted --exposure none with --blocks")
    for name in GEOMETRY_WEIGHTS:
        if getattr(options, name) > 0:
            raise LinprimError(f"--{name.replace('_', '-')} looks at whole views, of which a block has parts: wanted 0 with --blocks")


def blocks_that_fit(views: Sequence[View], options: TrainOptions, executor: Executor) -> int:
    """The least number of blocks, 1 or more, each of which a worker should have the memory for when all workers are at it."""
    _, memory = executor.capacity()
    whole = memory_estimate(views, options)
    if whole <= memory:
        return 1
    fixed = memory_estimate(views[:1], replace(options, max_primitives=1, initial_primitives=0))
    if fixed >= memory:
        wanted = "wanted a larger --downscale, or more memory"
        raise LinprimError(f"a worker has {memory:.1f} GiB and one photograph takes {fixed:.1f} GiB: {wanted}")
    return max(2, math.ceil(OVERLAP * (whole - fixed) / (memory - fixed)))


def save_points(path: Path, cloud: PointCloud) -> None:
    """Writes the points that a scene starts from."""
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, xyz=cloud.xyz, rgb=cloud.rgb, volume=isinstance(cloud, VolumePoints))


def load_points(path: Path) -> PointCloud:
    """Reads what `save_points` wrote."""
    with np.load(path, allow_pickle=False) as file:
        return (VolumePoints if file["volume"] else PointCloud)(file["xyz"], file["rgb"])


# --- the driver -------------------------------------------------------------------------------------------


def _all(run: Run, scene: Scene, count: int, executor: Executor, progress: Progress) -> dict:
    """What `train_blocks` does when there are several."""
    options, folder = run.train_options, run.path / FOLDER
    cores = options.threads or os.cpu_count() or 1
    progress.note(
        f"{scene.root}: {scene.kind}, {len(scene.train)} training and {len(scene.test)} held-out views in {count} blocks on {executor.what}"
    )
    coarse_run = coarse_of(run, scene)
    square = (coarse_run.scene_options.downscale // run.scene_options.downscale) ** 2
    photos, largest = photo_bytes(scene.train[:MOST_COARSE_VIEWS]), max(view.camera.width * view.camera.height for view in scene.train)
    need = memory_estimate((), coarse_run.train_options, photos // square, largest)
    where = {"run": str(run.path)}
    module = "linprim_geo.block_training"
    stage = Progress("coarse scene", 1, quiet=progress.quiet)
    (coarse,) = executor.run([Task("coarse scene", f"{module}:coarse_task", where, folder / "coarse", need, cores, REMEDY)], stage, _step)
    planning = Task("plan", f"{module}:plan_task", where | {"count": count}, folder / "plan", need, cores, REMEDY)
    (plan,) = executor.run([planning], Progress("plan", 1, quiet=progress.quiet))
    tasks = []
    for k, part in enumerate(plan["blocks"]):
        need = block_memory(part, plan, options)
        tasks.append(Task(f"block {k}", f"{module}:block_task", where | {"block": k}, folder / f"{k:03d}", need, 1, REMEDY))
        progress.note(
            f"  block {k}: {len(part['views'])} views, {part['pixels'] / max(1, plan['all_pixels']):.0%} of the pixels, "
            f"{part['iterations']} steps, {part['max_primitives']} primitives, {need:.1f} GiB"
        )
    results = executor.run(tasks, Progress("blocks", 1, quiet=progress.quiet), _step)
    return _merged(run, scene, coarse, plan, results, progress)


def _step(task: Task) -> str:
    """How far a task's training is, from its table."""
    try:
        last = (Path(task.folder) / "run" / "metrics.jsonl").read_bytes().splitlines()[-1]
        line = json.loads(last)
        return f"step {line['step']} PSNR {line['train_psnr']:.1f}"
    except (OSError, ValueError, KeyError, IndexError, TypeError):
        return "begun"


def _merged(run: Run, scene: Scene, coarse: dict, plan: dict, results: Sequence[dict], progress: Progress) -> dict:
    """Writes the primitives that the blocks own as those of the run, and scores them."""
    from .eval.images import psnr, to_8bit

    kept = []
    for k in range(len(results)):
        primitives = Run.open(run.path / FOLDER / f"{k:03d}" / "run").training_primitives()
        kept.append(select(primitives, block_of(plan, k).holds(primitives.center)))
    together = {name: np.concatenate([part[name] for part in kept]) for name in ARRAYS}
    if len(together["center"]) == 0:
        raise LinprimError(f"{run.path}: no block has kept a primitive, so there is no scene")
    merged = Primitives(**together, kind=run.train_options.primitive)
    seconds = sum(result["seconds"] for result in results)
    steps = run.train_options.iterations
    state = {"iteration": steps, "iterations": steps, "primitives": len(merged), "background": plan["shown"], "seconds": seconds}
    run.save(merged, state)
    scores = []
    for view, images in run.render_views(scene.test, geometry=False):
        photo = view.load()
        rgb = photo.rgb.astype(np.float32).transpose(2, 0, 1) / 255
        if photo.alpha is not None:
            alpha = photo.alpha.astype(np.float32) / 255
            rgb = rgb * alpha + np.asarray(plan["shown"], np.float32)[:, None, None] * (1 - alpha)
        scores.append(psnr(to_8bit(images["rgb"]), to_8bit(rgb)))
    score = float(np.mean(scores)) if scores else None
    peak = max(result["task_peak_gib"] for result in results)
    line = {"step": steps, "seconds": round(seconds, 3), "primitives": len(merged), "memory_gib": round(peak, 3)}
    for name in ("loss", "train_psnr"):
        line[name] = round(float(np.average([result[name] for result in results], weights=[part["pixels"] for part in plan["blocks"]])), 6)
    if score is not None:
        line["psnr"] = round(score, 4)
    with atomic_write(run.path / "metrics.jsonl") as temporary:
        temporary.write_text(json.dumps(line) + "\n")
    progress.note(
        f"{run.path}: {len(results)} blocks in {duration(seconds)} of steps, {len(merged)} primitives, {peak:.2f} GiB at most"
        + (f", held-out PSNR {score:.2f} dB over {len(scores)} views" if scores else "")
    )
    return {
        "run": str(run.path),
        "iterations": steps,
        "seconds": seconds,
        "primitives": len(merged),
        "psnr": score,
        "views": len(scores),
        "blocks": len(results),
        "block_peak_gib": peak,
        "coarse_seconds": coarse["task_seconds"],
        "worker_seconds": coarse["task_seconds"] + sum(result["task_seconds"] for result in results),
    }


def select(primitives: Primitives, rows: np.ndarray) -> dict[str, np.ndarray]:
    """The arrays of some of the primitives."""
    return {name: getattr(primitives, name)[rows] for name in ARRAYS}


# --- tasks ------------------------------------------------------------------------------------------------


def coarse_of(run: Run, scene: Scene) -> Run:
    """The run of the whole scene with fewer pixels, views, steps and primitives that stands for what a block does not hold."""
    options, scene_options = run.train_options, run.scene_options
    side = min(min(view.camera.width, view.camera.height) for view in scene.train)
    factor = COARSE_DOWNSCALE if side >= COARSE_DOWNSCALE * LEAST_SIDE else 1
    most = max(1, min(MOST_COARSE_PRIMITIVES, round(COARSE_PRIMITIVES * options.max_primitives)))
    coarse = replace(
        options,
        iterations=max(min(LEAST_STEPS, options.iterations), round(COARSE_STEPS * options.iterations)),
        max_primitives=most, initial_primitives=0, sh_degree=0, samples=1, evaluate_every=0,
    )  # fmt: skip
    views = min(scene_options.views or len(scene.train), MOST_COARSE_VIEWS)
    seen = replace(scene_options, downscale=factor * scene_options.downscale, views=views)
    return replace(run, path=run.path / FOLDER / "coarse" / "run", scene_options=seen, train_options=coarse)


def _opened(run: str) -> tuple[Run, Scene]:
    """The run and its scene with the points to start from."""
    opened = Run.open(run)
    return opened, replace(opened.scene(), points=load_points(opened.path / FOLDER / "points.npz"))


def _prepared(options: TrainOptions) -> None:
    torch.set_num_threads(1)
    ops.set_threads(worker.cores)


def coarse_task(folder: Path, run: str) -> dict:
    """Trains the coarse scene. Returns the background that it shows, `fitted`, and whether training draws a random one."""
    opened, scene = _opened(run)
    _prepared(opened.train_options)
    coarse = coarse_of(opened, scene)
    small = replace(coarse.scene(), points=scene.points)
    with locked(coarse.path, "trained into"):
        background, fitted, random = chosen_background(coarse.train_options.background, load_shots(small.train, coarse.similarity))
        state = read_checkpoint(coarse.path) if (coarse.path / "config.json").exists() else None
        done = train_run(coarse, small, state, Progress("coarse scene", 1, quiet=True))
    shown_color = [float(x) for x in (Run.open(coarse.path).background if fitted else background)]
    return {"background": "random" if random else ",".join(map(repr, shown_color)), "shown": shown_color, "seconds": done["seconds"]}


def plan_task(folder: Path, run: str, count: int) -> dict:
    """Splits space, and finds the views that show each block. Returns the plan that `block_task` reads."""
    opened, scene = _opened(run)
    _prepared(opened.train_options)
    coarse = Run.open(opened.path / FOLDER / "coarse" / "run")
    factor = coarse.scene_options.downscale // opened.scene_options.downscale
    assert scene.points is not None
    points = opened.similarity.apply(scene.points.xyz)
    depths = list(small_depths(coarse, scene.train, factor))
    seen = [(camera, depth, view.camera.width * view.camera.height) for view, (camera, depth) in zip(scene.train, depths, strict=True)]
    work = point_work(points, seen)
    used = work > 0
    if not used.any():
        raise LinprimError(f"{scene.root}: no camera sees a point of the scene, so no block can be made")
    blocks = split_space(points[used], work[used], count)
    margin = margin_of(blocks, points[used])
    options = opened.train_options
    parts = []
    for k, block in enumerate(blocks):
        views, pixels = [], 0
        for number, (view, (camera, depth)) in enumerate(zip(scene.train, depths, strict=True)):
            found = window(shown(block, margin, camera, depth), view.camera, factor)
            if found is not None:
                views.append(number)
                pixels += found[1][2] * found[1][3]
        if len(views) < 2:
            raise LinprimError(f"block {k} of {count} is seen by {len(views)} cameras, wanted two at least: fewer blocks")
        share = float(work[block.holds(points, margin)].sum() / work.sum())
        most = max(1, math.ceil(share * options.max_primitives))
        steps = math.ceil(options.iterations * len(views) / len(scene.train))
        parts.append(
            {
                "low": [_plain(x) for x in block.low],
                "high": [_plain(x) for x in block.high],
                "views": views,
                "pixels": pixels,
                "work": float(work[block.holds(points)].sum() / work.sum()),
                "iterations": max(min(LEAST_STEPS, options.iterations), steps),
                "max_primitives": most,
                "initial_primitives": min(most, math.ceil(share * options.initial_primitives)),
            }
        )
    background = worker.result_of_folder(opened.path / FOLDER / "coarse")
    largest = max(view.camera.width * view.camera.height for view in scene.train)
    return {
        "margin": margin,
        "factor": factor,
        "background": background["background"],
        "shown": background["shown"],
        "frozen": len(coarse.training_primitives()),
        "largest": largest,
        "all_pixels": sum(view.camera.width * view.camera.height for view in scene.train),
        "blocks": parts,
    }


def _plain(x: float) -> float | None:
    return float(x) if math.isfinite(x) else None


def block_of(plan: dict, k: int) -> Block:
    """A block of the plan."""
    part = plan["blocks"][k]
    low, high = ([x if x is not None else end for x in part[name]] for name, end in (("low", -np.inf), ("high", np.inf)))
    return Block(tuple(low), tuple(high))


def block_memory(part: dict, plan: dict, options: TrainOptions) -> float:
    """GiB that training a block of the plan takes."""
    count = part["max_primitives"] + plan["frozen"]
    return memory_estimate((), replace(options, max_primitives=count, initial_primitives=0), 4 * part["pixels"], plan["largest"])


def block_task(folder: Path, run: str, block: int) -> dict:
    """Trains a block of the plan before the coarse scene. What it does not own is dropped when the blocks are merged."""
    opened, scene = _opened(run)
    _prepared(opened.train_options)
    plan = worker.result_of_folder(opened.path / FOLDER / "plan")
    part, own, margin = plan["blocks"][block], block_of(plan, block), plan["margin"]
    names = ("iterations", "max_primitives", "initial_primitives")
    options = replace(
        opened.train_options, **{name: part[name] for name in names}, background=plan["background"], evaluate_every=0, threads=worker.cores
    )
    path = folder / "run"
    seen = replace(scene, train=tuple(scene.train[k] for k in part["views"]), test=())
    coarse = Run.open(opened.path / FOLDER / "coarse" / "run")
    shots, frozen = block_shots(coarse, seen.train, own, margin, plan["factor"], opened.similarity, options)
    here = replace(opened, path=path, train_options=options)

    def region(cloud: PointCloud) -> PointCloud:
        inside = own.holds(opened.similarity.apply(cloud.xyz), margin)
        if not inside.any():
            raise LinprimError(f"block {block} holds no point to start from: wanted fewer blocks")
        return PointCloud(cloud.xyz[inside], cloud.rgb[inside])

    with locked(path, "trained into"):
        begun = (path / "config.json").exists()
        state = read_checkpoint(path) if begun else None
        trainer: Trainer = start_trainer(seen, here, shots, options, state, region)
        trainer.frozen = frozen
        if not begun:
            about = opened.scene_path, opened.scene_options, options, opened.similarity, ops.instruction_set()
            Run.create(path, seen, *about)
        for torn in [*path.glob(".*.tmp*"), *path.glob("checkpoints/.*.tmp*")]:
            torn.unlink()
        seconds, _, _ = run_steps(trainer, here, [], Progress(f"block {block}", options.iterations, quiet=True))
    kept = int(own.holds(trainer.primitives().center).sum())
    return {"seconds": seconds, "primitives": len(trainer), "kept": kept, "loss": trainer.loss, "train_psnr": trainer.psnr}
