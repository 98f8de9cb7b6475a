"""Train a large scene in blocks of space.

First a coarse model of the whole scene is trained, then each block alone with the frozen coarse model around it, then,
in several exchange rounds, each block with its neighbours' current primitives around it. Finally the primitives of all
blocks are merged into one run.

RUN/blocks holds `points.npz` (the initial points), `coarse`, `plan`, and a folder with a run for each block and round,
`000`, `000joined1`, ..., `000joined3`, `001`, ..., with markers of finished tasks. RUN itself is a run like any other,
but without checkpoints.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Collection, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from linprim_geo.base.cores import usable_cores
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write, locked
from linprim_geo.base.options import GEOMETRY_WEIGHTS, SceneOptions, TrainOptions, check_train_options
from linprim_geo.base.progress import Progress, duration
from linprim_geo.capture.types import Scene, View
from linprim_geo.geometry.boxes import MARGIN
from linprim_geo.geometry.primitives import Primitives
from linprim_geo.jobs.executor import Executor, Task
from linprim_geo.jobs.open import open_executor
from linprim_geo.kernels import ops
from linprim_geo.points.start_points import with_points
from linprim_geo.runs.run import Run, is_unused
from linprim_geo.training.blocks.plan import (
    EXCHANGES,
    FOLDER,
    MOST_BESIDE,
    MOST_COARSE_PRIMITIVES,
    MOST_COARSE_VIEWS,
    Plan,
    coarse_of,
    save_points,
)
from linprim_geo.training.blocks.tasks import block_folder, concatenated, select
from linprim_geo.training.budget.memory import bytes_per_primitive, memory_estimate
from linprim_geo.training.effects import Choice
from linprim_geo.training.start import begin_run, reopen_run
from linprim_geo.training.step.training_images import MOST_KEPT, RECENT, photo_bytes

# Factor by which the margin increases a block's primitives if the block has neighbours on all sides of a square ground
# plan; other blocks have smaller factors.
OVERLAP = (1 + 2 * MARGIN) ** 2
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
) -> dict | None:
    """Train a scene in blocks of space into a run folder. Return None, and write nothing, if one block is enough.

    Steps and primitives in `options` are totals for the scene. A block is trained with the views that show it, each as
    often as in a training of the whole scene, and with its share of the primitives. The primitives of its margin come
    on top; they are trained twice and dropped. The sum may miss `max_primitives` by a few primitives that have crossed
    a border. With `--population 3dgs|mcmc` the limit includes the margin, and the sum may miss it by percents.

    Args:
        blocks: number of blocks; "auto": as few as a worker's memory allows.
        cluster, workers: where to run and how many at once, see `jobs.open.open_executor`.

    Returns: as `train`, and `blocks`, `block_peak_gib` (the largest memory of a worker), `coarse_seconds` and
    `worker_seconds`.

    Raises:
        LinprimError: as `train`; a block that no camera sees; an option that needs the whole scene; whatever `executor`
            raises.
    """
    run_path, where = Path(run).resolve(), Path(scene)
    check_train_options(options := options or TrainOptions())
    scene_options = scene_options or SceneOptions()
    given = frozenset() if effects is None else effects.given
    check_options(options, blocks, given)
    progress = Progress("blocks", 1, quiet=quiet)
    before = torch.get_num_threads()
    resume = resume and not is_unused(run_path)
    try:
        torch.set_num_threads(1)
        with locked(run_path, "trained into"):
            ops.set_threads(options.threads)
            if resume:
                begun = Run.open(run_path).notes.get("blocks")
                ignored = ["--blocks"] if blocks not in (1, begun) else []
                opened, loaded = reopen_run(where, run_path, scene_options, options, progress, effects, ignored)
                count: int | None = begun
                if type(count) is not int or count < 2:
                    raise LinprimError(f"{run_path}: was not begun in blocks, wanted --resume without --blocks")
                loaded = with_points(loaded, opened.train_options, progress.note)
            else:
                opened, loaded, decisions = begin_run(
                    where, run_path, scene_options, options, effects or Choice("none"), progress
                )
                check_options(opened.train_options, blocks)
                loaded = with_points(loaded, opened.train_options, progress.note)
                count = None if blocks == "auto" else int(blocks)
            if count is None:
                with (
                    TemporaryDirectory(prefix="linprim_geo_") as folder,
                    open_executor(cluster, Path(folder), workers) as executor,
                ):
                    count = blocks_that_fit(loaded.train, opened.train_options, executor)
            if count > 1:
                if not resume:
                    notes = (
                        opened.scene_path,
                        opened.scene_options,
                        opened.train_options,
                        opened.similarity,
                        ops.instruction_set(),
                    )
                    Run.create(run_path, loaded, *notes, [asdict(decision) for decision in decisions], blocks=count)
                assert loaded.points is not None
                save_points(run_path / FOLDER / "points.npz", loaded.points)
                with open_executor(cluster, run_path / FOLDER, workers) as executor:
                    return _all(replace(opened, path=run_path), loaded, count, executor, progress)
    finally:
        torch.set_num_threads(before)
    progress.note("one block holds it all")
    return None


def check_options(options: TrainOptions, blocks: int | str, given: Collection[str] = ()) -> None:
    """Raise LinprimError for options that cannot be used with blocks. `given` are names of options that the user has
    set, possibly to their defaults."""
    if blocks != "auto" and not 1 <= int(blocks) <= 10**6:
        raise LinprimError(f"--blocks is {blocks}, wanted auto, or a number from 1")
    if options.exposure != "none":
        raise LinprimError(
            "--exposure gain is fitted over all photographs at once: wanted --exposure none with --blocks"
        )
    # By default only the coarse model is supervised by stereo depths.
    asked = "stereo_depth" in given or options.stereo_depth != TrainOptions.stereo_depth
    for name in (*GEOMETRY_WEIGHTS, *["stereo_depth"] * asked):
        if getattr(options, name) > 0:
            raise LinprimError(
                f"--{name.replace('_', '-')} looks at whole views, of which a block has parts: wanted 0 with --blocks"
            )


def blocks_that_fit(views: Sequence[View], options: TrainOptions, executor: Executor) -> int:
    """Return the smallest number of blocks, 1 or more, for which each block should fit into a worker's memory.

    Only primitives are divided among the blocks; a worker holds few of a block's photographs at a time.
    """
    _, memory = executor.capacity()
    if memory_estimate(views, options, min(photo_bytes(tuple(views)), MOST_KEPT)) <= memory:
        return 1
    largest = max(view.camera.width * view.camera.height for view in views)
    fixed = block_memory(0, min(MOST_COARSE_PRIMITIVES, options.max_primitives), largest, options)
    if fixed >= memory:
        wanted = "wanted a larger --downscale, or more memory"
        raise LinprimError(
            f"a worker has {memory:.1f} GiB and a block of the fewest primitives takes {fixed:.1f} GiB: {wanted}"
        )
    primitives = bytes_per_primitive(options) * options.max_primitives / 2**30
    return max(2, math.ceil(OVERLAP * primitives / (memory - fixed)))


def block_memory(primitives: int, coarse: int, largest: int, options: TrainOptions) -> float:
    """Return the GiB that a worker needs to train `primitives` of a block and its margin, with `coarse` frozen
    primitives of the coarse model and, after an exchange, those of other blocks.

    Args:
        largest: pixels of the largest photograph. A worker holds only the last photographs that it used.
        options: those of the whole scene.
    """
    count = primitives + coarse + min(MOST_BESIDE, options.max_primitives)
    return memory_estimate(
        (), replace(options, max_primitives=count, initial_primitives=0), 4 * RECENT * largest, largest
    )


# --- the driver -------------------------------------------------------------------------------------------


def _all(run: Run, scene: Scene, count: int, executor: Executor, progress: Progress) -> dict:
    """Run all stages of `train_blocks` if there are several blocks."""
    options, folder = run.train_options, run.path / FOLDER
    cores = options.threads or usable_cores()
    progress.note(
        f"{scene.root}: {scene.kind}, {len(scene.train)} training and {len(scene.test)} held-out views in "
        f"{count} blocks on {executor.what}"
    )
    coarse_run = coarse_of(run, scene)
    square = (int(coarse_run.scene_options.downscale) // scene.downscale) ** 2
    photos, largest = (
        photo_bytes(scene.train[:MOST_COARSE_VIEWS]),
        max(view.camera.width * view.camera.height for view in scene.train),
    )
    need = memory_estimate((), coarse_run.train_options, photos // square, largest)
    where = {"run": str(run.path)}
    module = "linprim_geo.training.blocks.tasks"
    stage = Progress("coarse scene", 1, quiet=progress.quiet)
    (coarse,) = executor.run(
        [Task("coarse scene", f"{module}:coarse_task", where, folder / "coarse", need, cores, REMEDY)], stage, _step
    )
    planning = Task(
        "plan",
        "linprim_geo.training.blocks.plan:plan_task",
        where | {"count": count},
        folder / "plan",
        need,
        cores,
        REMEDY,
    )
    (planned,) = executor.run([planning], Progress("plan", 1, quiet=progress.quiet))
    plan = Plan.from_json(planned, run.path)
    rounds, memory = [], []
    for k, part in enumerate(plan.blocks):
        memory.append(block_memory(part.max_primitives, plan.frozen, plan.largest, options))
        progress.note(
            f"  block {k}: {len(part.views)} views, {part.pixels / max(1, plan.all_pixels):.0%} of the pixels, "
            f"{part.iterations} steps, {part.max_primitives} primitives, {memory[k]:.1f} GiB"
        )
    for exchange in range(len(EXCHANGES) + 1):
        title = f"exchange {exchange} of {len(EXCHANGES)}" if exchange else "blocks"
        tasks = []
        for k, need in enumerate(memory):
            name, function, arguments = f"block {k}", f"{module}:block_task", where | {"block": k}
            if exchange:
                name, function, arguments = (
                    f"{name}, exchange {exchange}",
                    f"{module}:join_task",
                    arguments | {"exchange": exchange},
                )
            tasks.append(Task(name, function, arguments, block_folder(run.path, k, exchange), need, 1, REMEDY))
        rounds.append(executor.run(tasks, Progress(title, 1, quiet=progress.quiet), _step))
    return _merged(run, scene, coarse, plan, rounds, progress)


def _step(task: Task) -> str:
    """Return a short progress text of a task's training, from the last line of its metrics table."""
    try:
        last = (Path(task.folder) / "run" / "metrics.jsonl").read_bytes().splitlines()[-1]
        line = json.loads(last)
        return f"step {line['step']} PSNR {line['train_psnr']:.1f}"
    except (OSError, ValueError, KeyError, IndexError, TypeError):
        return "begun"


def _merged(run: Run, scene: Scene, coarse: dict, plan: Plan, rounds: Sequence[list[dict]], progress: Progress) -> dict:
    """Write the primitives that the blocks own as those of the run, and score them. `rounds` are the tasks' results."""
    from linprim_geo.imaging.metrics import psnr, to_8bit

    ended, results = rounds[-1], [result for each in rounds for result in each]
    kept = []
    for k, result in enumerate(ended):
        primitives = Run.open(block_folder(run.path, k, len(EXCHANGES)) / "run").training_primitives()
        kept.append(select(primitives, np.arange(len(primitives)) < result["owned"]))
    together = concatenated(kept)
    if len(together["center"]) == 0:
        raise LinprimError(f"{run.path}: no block has kept a primitive, so there is no scene")
    merged = Primitives(**together, kind=run.train_options.primitive)
    seconds = sum(result["seconds"] for result in ended)
    steps = run.train_options.iterations
    state = {
        "iteration": steps,
        "iterations": steps,
        "primitives": len(merged),
        "background": list(plan.shown),
        "seconds": seconds,
    }
    run.save(merged, state, Run.open(run.path / FOLDER / "coarse" / "run").environment)
    scores = []
    for view, images in run.render_views(scene.test, geometry=False):
        photo = view.load()
        rgb = photo.rgb.astype(np.float32).transpose(2, 0, 1) / 255
        if photo.alpha is not None:
            alpha = photo.alpha.astype(np.float32) / 255
            rgb = rgb * alpha + np.asarray(plan.shown, np.float32)[:, None, None] * (1 - alpha)
        scores.append(psnr(to_8bit(images["rgb"]), to_8bit(rgb)))
    score = float(np.mean(scores)) if scores else None
    peak = max(result["task_peak_gib"] for result in results)
    line = {"step": steps, "seconds": round(seconds, 3), "primitives": len(merged), "memory_gib": round(peak, 3)}
    for name in ("loss", "train_psnr"):
        line[name] = round(
            float(np.average([result[name] for result in ended], weights=[part.pixels for part in plan.blocks])),
            6,
        )
    if score is not None:
        line["psnr"] = round(score, 4)
    with atomic_write(run.path / "metrics.jsonl") as temporary:
        temporary.write_text(json.dumps(line) + "\n")
    progress.note(
        f"{run.path}: {len(ended)} blocks in {duration(seconds)} of steps, {len(merged)} primitives, {peak:.2f} "
        "GiB at most" + (f", held-out PSNR {score:.2f} dB over {len(scores)} views" if scores else "")
    )
    return {
        "run": str(run.path),
        "iterations": steps,
        "seconds": seconds,
        "primitives": len(merged),
        "psnr": score,
        "views": len(scores),
        "blocks": len(ended),
        "block_peak_gib": peak,
        "coarse_seconds": coarse["task_seconds"],
        "worker_seconds": coarse["task_seconds"] + sum(result["task_seconds"] for result in results),
    }
