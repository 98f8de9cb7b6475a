"""What workers do in a training in blocks: train the coarse scene, train one block alone, then again with its
neighbours' current primitives frozen around it.

Every task reads what those before it left in RUN/blocks, and goes on from its own last checkpoint.
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
from linprim_geo.points.far_colors import far_colors
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

# Arrays of primitives by name, of any number: the frozen ones may be none.
Arrays = dict[str, np.ndarray]


def coarse_task(folder: Path, run: str) -> dict:
    """Trains the coarse scene. Returns the background to train with, as the option says it, its colour, and whether
    that is fitted."""
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
        if state is not None:  # with what has been chosen at its start
            begun = replace(Run.open(coarse.path).train_options, threads=coarse.train_options.threads)
            coarse = replace(coarse, train_options=begun)
        done = train_run(coarse, small, state, Progress("coarse scene", 1, quiet=True))
    shown_color = [float(x) for x in (Run.open(coarse.path).background if behind.fitted else behind.color)]
    # What the coarse environment shows is transparent in the windows of blocks.
    background_option = "random" if behind.random or behind.environment else ",".join(map(repr, shown_color))
    about = {"fitted": behind.fitted, "environment": behind.environment, "seconds": done["seconds"]}
    return {"background": background_option, "shown": shown_color} | about


def block_task(folder: Path, run: str, block: int) -> dict:
    """Trains a block of the plan and its margin before the coarse scene, up to the first exchange."""
    opened, scene = _opened(run)
    plan = read_plan(opened.path)
    own, margin = plan.blocks[block].block, plan.margin
    coarse = Run.open(opened.path / FOLDER / "coarse" / "run").training_primitives()
    return _trained(
        folder, opened, scene, plan, block, outside(coarse, own, margin), margin, until(opened.train_options, 0), None
    )


def join_task(folder: Path, run: str, block: int, exchange: int) -> dict:
    """Trains a block from the `exchange`th of EXCHANGES, counted from 1, to the next or to the end, beside what its
    neighbours have become.

    What they own in its margin is trained with it, so that both sides of a border fit each other, and then dropped: the
    restricted additive Schwarz method (Cai and Sarkis, SIAM J. Sci. Comput. 21, 1999). Beyond the margin their
    primitives stand still, and farther off the coarse scene does. Returns as `_trained`, and `owned`: so many, the
    first ones, are the block's.
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


# What a checkpoint holds for every primitive, in tables by name and as tensors.
_TABLES, _TENSORS = ("parameters", "first", "second", "accumulated"), ("steps", "filter_3d")


def _rows(state: dict, keep: np.ndarray) -> dict:
    """That of some of the primitives."""
    rows = torch.from_numpy(keep)
    tables = {name: {key: value[rows] for key, value in state[name].items()} for name in _TABLES}
    return tables | {name: None if state[name] is None else state[name][rows] for name in _TENSORS}


def _concatenate_rows(parts: Sequence[dict]) -> dict:
    """That of all of them."""
    tables = {name: {key: torch.cat([part[name][key] for part in parts]) for key in parts[0][name]} for name in _TABLES}
    return tables | {
        name: None if parts[0][name] is None else torch.cat([part[name] for part in parts]) for name in _TENSORS
    }


def until(options: TrainOptions, exchange: int) -> float:
    """The part of its steps that a block has behind it when the task that begins with an exchange, 0 for the first
    task, ends."""
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
    """Trains a block in folder/run up to a part of its steps, from its last checkpoint there, else from the state
    `begin`, else from the points in it and its margin. Up to `exact_radius` from the block the frozen primitives are
    those that the scene will have."""
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
    """The scene's points in a block and its margin, filled up: at most as many in either as a training begins with that
    has the block's own primitives in the one and the others of its `options` in the other."""
    far = far_colors(scene) if plan.environment else None
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
    """Where the task of a block works before the first exchange, or after the `exchange`th."""
    return run / FOLDER / (f"{block:03d}joined{exchange}" if exchange else f"{block:03d}")


def is_owned(run: Path, plan: Plan, block: int, exchange: int, state: dict) -> np.ndarray:
    """(N,) which primitives of a block's state after an exchange are its own. That is decided at the first; later they
    may leave it."""
    if exchange == 0:
        return plan.blocks[block].block.holds(_centers(state))
    return np.arange(len(_centers(state))) < worker.result_of_folder(block_folder(run, block, exchange))["owned"]


def outside(primitives: Primitives, block: Block, margin: float) -> Arrays:
    """Those outside of a block and its margin, but for those that reach into the block."""
    reach = primitives.extent.max(1)[:, None]
    low, high = np.asarray(block.low), np.asarray(block.high)
    apart = ((primitives.center + reach < low) | (primitives.center - reach > high)).any(1)
    return select(primitives, apart & ~block.holds(primitives.center, margin))


def select(primitives: Primitives, rows: np.ndarray) -> Arrays:
    """The arrays of some of the primitives."""
    return {name: getattr(primitives, name)[rows] for name in ARRAYS}


def concatenated(parts: Sequence[Arrays]) -> Arrays:
    """All of them in one, with the harmonics of the one that has most."""
    count = max(part["sh"].shape[1] for part in parts)
    padded = [part | {"sh": np.pad(part["sh"], ((0, 0), (0, count - part["sh"].shape[1]), (0, 0)))} for part in parts]
    return {name: np.concatenate([part[name] for part in padded]) for name in ARRAYS}


def tensors(arrays: Arrays) -> Tensors:
    """As the rasterizer takes them."""
    center, rotation, extent, density, sh = (torch.from_numpy(arrays[name]) for name in ARRAYS)
    return center, rotation, extent, density, sh
