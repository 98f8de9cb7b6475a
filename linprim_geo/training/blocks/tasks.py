"""Tasks that workers run in a training in blocks: train the coarse model, train one block alone, then train it again
with its neighbours' current primitives around it.

Each task reads the results of earlier ones from RUN/blocks, and resumes from its own last checkpoint.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import locked
from linprim_geo.base.options import TrainOptions
from linprim_geo.base.progress import Progress
from linprim_geo.capture.types import PointCloud, Scene
from linprim_geo.geometry.boxes import Block
from linprim_geo.geometry.primitives import ARRAYS, Primitives, Tensors
from linprim_geo.jobs import worker
from linprim_geo.kernels import ops
from linprim_geo.points.colors_at_infinity import colors_at_infinity
from linprim_geo.points.start_points import filled_points, initial_cloud
from linprim_geo.runs.run import Run
from linprim_geo.training.background import chosen_background
from linprim_geo.training.blocks.plan import EXCHANGES, FOLDER, Plan, _opened, _prepared, coarse_of, read_plan
from linprim_geo.training.blocks.windows import block_images
from linprim_geo.training.checkpoint import read_checkpoint
from linprim_geo.training.loop import run_steps
from linprim_geo.training.single import train_run
from linprim_geo.training.start import start_trainer
from linprim_geo.training.step.trainer import CONTROLS
from linprim_geo.training.step.training_images import load_training_images
from linprim_geo.training.stereo_surfaces import stereo_surfaces

# Arrays of primitives by name. Unlike `Primitives` they may be empty, as the frozen ones can be.
Arrays = dict[str, np.ndarray]


def coarse_task(folder: Path, run: str) -> dict:
    """Train the coarse model. Return the background option for the blocks, its colour, and whether that is fitted."""
    opened, scene = _opened(run)
    _prepared(opened.train_options)
    coarse = coarse_of(opened, scene)
    small = replace(coarse.scene(), points=scene.points)
    small = small if scene.adjusted is None else scene.adjusted.applied(small)
    with locked(coarse.path, "trained into"):
        behind = chosen_background(
            coarse.train_options.background, small, load_training_images(small.train, coarse.similarity)
        )
        state = read_checkpoint(coarse.path) if (coarse.path / "config.json").exists() else None
        if state is not None:  # keep the options that were chosen at its start
            begun = replace(Run.open(coarse.path).train_options, threads=coarse.train_options.threads)
            coarse = replace(coarse, train_options=begun)
        done = train_run(coarse, small, state, Progress("coarse scene", 1, quiet=True))
    shown_color = [float(x) for x in (Run.open(coarse.path).background if behind.fitted else behind.color)]
    # Pixels that show the coarse model's environment map are transparent in the crops of blocks.
    background_option = "random" if behind.random or behind.environment else ",".join(map(repr, shown_color))
    about = {"fitted": behind.fitted, "environment": behind.environment, "seconds": done["seconds"]}
    return {"background": background_option, "shown": shown_color} | about


def block_task(folder: Path, run: str, block: int) -> dict:
    """Train a block of the plan and its margin, with the frozen coarse model around them, up to the first exchange."""
    opened, scene = _opened(run)
    plan = read_plan(opened.path)
    own, margin = plan.blocks[block].block, plan.margin
    coarse = Run.open(opened.path / FOLDER / "coarse" / "run").training_primitives()
    return _trained(
        folder, opened, scene, plan, block, outside(coarse, own, margin), margin, until(opened.train_options, 0), None
    )


def join_task(folder: Path, run: str, block: int, exchange: int) -> dict:
    """Train a block from the `exchange`th of EXCHANGES, counted from 1, to the next or to the end, with its neighbours'
    current primitives around it.

    The neighbours' primitives in its margin are trained with it, so that both sides of a border fit each other, and
    then dropped: the restricted additive Schwarz method (Cai and Sarkis, SIAM J. Sci. Comput. 21, 1999). Beyond the
    margin their primitives are frozen, and farther away the frozen coarse model is used. Returns as `_trained`, and
    `owned`: the number of primitives that belong to the block, which come first.
    """
    opened, scene = _opened(run)
    plan = read_plan(opened.path)
    own, exact_radius, margin = plan.blocks[block].block, plan.blocks[block].exact_radius, plan.margin
    state = _state_of(opened.path, block, exchange - 1)
    begin = [_rows(state, is_owned(opened.path, plan, block, exchange - 1, state))]
    frozen = [outside(Run.open(opened.path / FOLDER / "coarse" / "run").training_primitives(), own, exact_radius)]
    for other, part in enumerate(plan.blocks):
        if other != block and not own.is_apart(part.block, exact_radius):
            theirs = _state_of(opened.path, other, exchange - 1)
            center, rows = _centers(theirs), is_owned(opened.path, plan, other, exchange - 1, theirs)
            inside = own.holds(center, margin)
            begin.append(_rows(theirs, rows & inside))
            still = Run.open(block_folder(opened.path, other, exchange - 1) / "run").training_primitives()
            frozen.append(select(still, rows & ~inside & own.holds(center, exact_radius)))
    count = len(_centers(begin[0]))
    if sum(len(_centers(each)) for each in begin):
        state |= _concatenate_rows(begin)
    end = until(opened.train_options, exchange)
    trained = _trained(folder, opened, scene, plan, block, concatenated(frozen), exact_radius, end, state)
    return trained | {"owned": count}


def _state_of(run: Path, block: int, exchange: int) -> dict:
    state = read_checkpoint(block_folder(run, block, exchange) / "run")
    assert state is not None
    return state


def _centers(state: dict) -> np.ndarray:
    return state["parameters"]["center"].numpy()


# Entries of a checkpoint with one row per primitive: tables of tensors by name, and single tensors.
_TABLES, _TENSORS = ("parameters", "first", "second", "accumulated"), ("steps", "filter_3d")


def _rows(state: dict, keep: np.ndarray) -> dict:
    """Return the per-primitive entries of a checkpoint for the primitives selected by `keep`."""
    rows = torch.from_numpy(keep)
    tables = {name: {key: value[rows] for key, value in state[name].items()} for name in _TABLES}
    return tables | {name: None if state[name] is None else state[name][rows] for name in _TENSORS}


def _concatenate_rows(parts: Sequence[dict]) -> dict:
    """Return the per-primitive entries of several checkpoints, concatenated."""
    tables = {name: {key: torch.cat([part[name][key] for part in parts]) for key in parts[0][name]} for name in _TABLES}
    return tables | {
        name: None if parts[0][name] is None else torch.cat([part[name] for part in parts]) for name in _TENSORS
    }


def until(options: TrainOptions, exchange: int) -> float:
    """Return the share of its steps that a block has completed at the end of a task. The task begins with the given
    exchange; 0 is the first task."""
    grows = CONTROLS[options.population].GROWS_UNTIL
    return grows + (1 - grows) * (*EXCHANGES, 1.0)[exchange]


def _trained(
    folder: Path,
    opened: Run,
    scene: Scene,
    plan: Plan,
    block: int,
    frozen: Arrays,
    exact_radius: float,
    end: float,
    begin: dict | None,
) -> dict:
    """Train a block in folder/run up to the share `end` of its steps.

    It starts from the last checkpoint there, else from the state `begin`, else from the points in the block and its
    margin. Up to `exact_radius` from the block, the frozen primitives are those of the full model; beyond, they are the
    coarse model's.
    """
    _prepared(opened.train_options)
    part, own = plan.blocks[block], plan.blocks[block].block
    options = replace(
        opened.train_options,
        iterations=part.iterations,
        max_primitives=part.max_primitives,
        initial_primitives=part.initial_primitives,
        background=plan.background,
        evaluate_every=0,
        threads=worker.cores,
    )
    path = folder / "run"
    seen = replace(scene, train=tuple(scene.train[k] for k in part.views), test=())
    with locked(path, "trained into"):
        begun = (path / "config.json").exists()
        state = (read_checkpoint(path) if begun else None) or begin
        cloud = _points_of(seen, opened, plan, block, options) if state is None else None
        coarse = Run.open(opened.path / FOLDER / "coarse" / "run")
        margin, factor, still = plan.margin, plan.factor, tensors(frozen)
        images = block_images(coarse, seen.train, own, margin, exact_radius, factor, opened.similarity, options, still)
        here = replace(opened, path=path, train_options=options)
        trainer = start_trainer(seen, here, images, options, state, cloud, plan.extent)
        trainer.frozen = still
        trainer.control.limit_only(own.holds, part.own_primitives, trainer.parameters, trainer.step)
        if not begun:
            about = opened.scene_path, opened.scene_options, options, opened.similarity, ops.instruction_set()
            Run.create(path, seen, *about)
        for torn in [*path.glob(".*.tmp*"), *path.glob("checkpoints/.*.tmp*")]:
            torn.unlink()
        steps = math.ceil(end * options.iterations)
        seconds, _, _ = run_steps(trainer, here, [], Progress(f"block {block}", steps, quiet=True), until=steps)
    return {"seconds": seconds, "primitives": len(trainer), "loss": trainer.loss, "train_psnr": trainer.psnr}


def _points_of(scene: Scene, run: Run, plan: Plan, number: int, options: TrainOptions) -> PointCloud:
    """Return the initial points in a block and its margin.

    The block and its margin are limited separately: to the number of points from which a training of the block's own
    primitives would start, and of the remaining primitives of `options`.
    """
    far = colors_at_infinity(scene) if plan.environment else None
    backdrop = np.asarray(plan.shown) if plan.fitted else None
    surfaces = stereo_surfaces(scene, replace(options, stereo_depth=0.0), Progress("block", 1, quiet=True))
    cloud = filled_points(scene, options.seed, backdrop, far, surfaces.points)
    where, block = run.similarity.apply(cloud.xyz), plan.blocks[number].block
    own = max(1, plan.blocks[number].own_primitives)
    inside, beside = block.holds(where), block.holds(where, plan.margin)
    if not beside.any():
        raise LinprimError(f"block {number} holds no point to start from: wanted fewer blocks")
    chosen = []
    for rows, most in ((inside, own), (beside & ~inside, options.max_primitives - own)):
        begin = math.ceil(options.initial_primitives * most / options.max_primitives)
        part = replace(options, max_primitives=max(0, most), initial_primitives=max(0, begin))
        chosen.append(initial_cloud(PointCloud(cloud.xyz[rows], cloud.rgb[rows]), part))
    return PointCloud(np.concatenate([part.xyz for part in chosen]), np.concatenate([part.rgb for part in chosen]))


def block_folder(run: Path, block: int, exchange: int = 0) -> Path:
    """Return the folder of a block's task before the first exchange, or after the `exchange`th."""
    return run / FOLDER / (f"{block:03d}joined{exchange}" if exchange else f"{block:03d}")


def is_owned(run: Path, plan: Plan, block: int, exchange: int, state: dict) -> np.ndarray:
    """Return (N,) which primitives of a block's state after an exchange belong to the block.

    Ownership is decided by position before the first exchange; later the primitives may leave the block.
    """
    if exchange == 0:
        return plan.blocks[block].block.holds(_centers(state))
    return np.arange(len(_centers(state))) < worker.result_of_folder(block_folder(run, block, exchange))["owned"]


def outside(primitives: Primitives, block: Block, margin: float) -> Arrays:
    """Return the primitives outside of a block and its margin, except those large enough to reach into the block."""
    reach = primitives.extent.max(1)[:, None]
    low, high = np.asarray(block.low), np.asarray(block.high)
    apart = ((primitives.center + reach < low) | (primitives.center - reach > high)).any(1)
    return select(primitives, apart & ~block.holds(primitives.center, margin))


def select(primitives: Primitives, rows: np.ndarray) -> Arrays:
    """Return the arrays of the selected primitives."""
    return {name: getattr(primitives, name)[rows] for name in ARRAYS}


def concatenated(parts: Sequence[Arrays]) -> Arrays:
    """Concatenate arrays of primitives. Spherical harmonics are padded to the largest number of coefficients."""
    count = max(part["sh"].shape[1] for part in parts)
    padded = [part | {"sh": np.pad(part["sh"], ((0, 0), (0, count - part["sh"].shape[1]), (0, 0)))} for part in parts]
    return {name: np.concatenate([part[name] for part in padded]) for name in ARRAYS}


def tensors(arrays: Arrays) -> Tensors:
    """Return the arrays as rasterizer inputs."""
    center, rotation, extent, density, sh = (torch.from_numpy(arrays[name]) for name in ARRAYS)
    return center, rotation, extent, density, sh
