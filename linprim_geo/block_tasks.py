"""What workers do when a scene is trained in blocks: the coarse scene, the plan, a block by itself, and it beside what
others have become.

Every task reads what those before it left in RUN/blocks, and goes on from its own last checkpoint.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from . import ops, worker
from .block_shots import block_shots, small_depths
from .blocks import Block, margin_of, point_work, split_space, surface_points, window
from .camera import Camera
from .checkpoint import read_checkpoint
from .environment import far_colors
from .errors import LinprimError
from .files import atomic_write, locked
from .initial_points import VolumePoints
from .ops import Tensors
from .options import TrainOptions
from .primitives import ARRAYS, Primitives
from .progress import Progress
from .run import Run
from .scene import PointCloud, Scene, View
from .shots import load_shots
from .train import train_run
from .trainer import CONTROLS
from .training_loop import run_steps
from .training_start import chosen_background, filled_points, initial_cloud, start_trainer

# Arrays of primitives by name, of any number: the frozen ones may be none.
Arrays = dict[str, np.ndarray]

FOLDER = "blocks"
# Goes up whenever tasks need what those of before have not left.
FORMAT = 3
# The coarse scene: pixels averaged, parts of the steps and of the primitives of the whole, and the most of these and of
# the views.
COARSE_DOWNSCALE, COARSE_STEPS, COARSE_PRIMITIVES = 2, 0.25, 0.25
MOST_COARSE_PRIMITIVES, MOST_COARSE_VIEWS, LEAST_SIDE = 20_000, 1000, 32
# Primitives are shared out as the coarse scene has grown them, but for this part, which goes by the pixels that show a
# block: the whole has four times as long to grow them where pixels ask for more.
BY_PIXELS = 0.25
# Steps of a block at least, as far as the whole has so many.
LEAST_STEPS = 300
# Blocks take up what others have become at these parts of the steps that are left once growth has ended. Then others
# stand in full, the nearest first, up to about so many primitives with those that are trained in the margin; beyond
# these the coarse scene does.
EXCHANGES, MOST_BESIDE = (0.125, 0.5, 0.8125), 100_000


def save_points(path: Path, cloud: PointCloud) -> None:
    """Writes the points that a scene starts from."""
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, xyz=cloud.xyz, rgb=cloud.rgb, volume=isinstance(cloud, VolumePoints))


def load_points(path: Path) -> PointCloud:
    """Reads what `save_points` wrote."""
    with np.load(path, allow_pickle=False) as file:
        return (VolumePoints if file["volume"] else PointCloud)(file["xyz"], file["rgb"])


def coarse_of(run: Run, scene: Scene) -> Run:
    """The run of the whole scene with fewer pixels, views, steps and primitives that stands for what a block does not
    hold."""
    options, scene_options = run.train_options, run.scene_options
    side = min(min(view.camera.width, view.camera.height) for view in scene.train)
    factor = COARSE_DOWNSCALE if side >= COARSE_DOWNSCALE * LEAST_SIDE else 1
    most = max(1, min(MOST_COARSE_PRIMITIVES, round(COARSE_PRIMITIVES * options.max_primitives)))
    views = min(scene_options.views or len(scene.train), MOST_COARSE_VIEWS)
    coarse = replace(
        options,
        iterations=max(
            min(LEAST_STEPS, options.iterations), round(COARSE_STEPS * options.iterations * views / len(scene.train))
        ),
        max_primitives=most,
        initial_primitives=0,
        sh_degree=0,
        samples=1,
        evaluate_every=0,
    )
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
    """Trains the coarse scene. Returns the background to train with, as the option says it, its colour, and whether
    that is fitted."""
    opened, scene = _opened(run)
    _prepared(opened.train_options)
    coarse = coarse_of(opened, scene)
    small = replace(coarse.scene(), points=scene.points)
    with locked(coarse.path, "trained into"):
        behind = chosen_background(coarse.train_options.background, small, load_shots(small.train, coarse.similarity))
        state = read_checkpoint(coarse.path) if (coarse.path / "config.json").exists() else None
        done = train_run(coarse, small, state, Progress("coarse scene", 1, quiet=True))
    shown_color = [float(x) for x in (Run.open(coarse.path).background if behind.fitted else behind.color)]
    # What the coarse environment shows is transparent in the windows of blocks.
    background_option = "random" if behind.random or behind.environment else ",".join(map(repr, shown_color))
    about = {"fitted": behind.fitted, "environment": behind.environment, "seconds": done["seconds"]}
    return {"background": background_option, "shown": shown_color} | about


def plan_task(folder: Path, run: str, count: int) -> dict:
    """Splits space, and finds the views that show each block. Returns the plan that `block_task` reads."""
    opened, scene = _opened(run)
    _prepared(opened.train_options)
    coarse = Run.open(opened.path / FOLDER / "coarse" / "run")
    factor = coarse.scene_options.downscale // opened.scene_options.downscale
    assert scene.points is not None
    points = opened.similarity.apply(scene.points.xyz)

    def looks() -> Iterator[tuple[View, Camera, np.ndarray]]:
        """Rendered twice: depths of all views take more memory than there may be."""
        for view, (camera, depth) in zip(scene.train, small_depths(coarse, scene.train, factor), strict=True):
            yield view, camera, depth

    work = point_work(
        points, ((camera, depth, view.camera.width * view.camera.height) for view, camera, depth in looks())
    )
    used = work > 0
    if not used.any():
        raise LinprimError(f"{scene.root}: no camera sees a point of the scene, so no block can be made")
    blocks = split_space(points[used], work[used], count)
    margin = margin_of(blocks, points[used])
    seen_by: list[list[int]] = [[] for _ in blocks]
    # Of windows, and of the coarse scene: in a block, and in it and its margin.
    pixels, within = [0] * count, np.zeros((2, count))
    for number, (view, camera, depth) in enumerate(looks()):
        if not (depth > 0).any():
            continue
        surface = surface_points(camera, depth)
        reach = Block(tuple(np.nanmin(surface, (0, 1))), tuple(np.nanmax(surface, (0, 1))))
        for k, block in enumerate(blocks):
            if reach.is_apart(block, margin):
                continue
            mask = block.holds(surface, margin)
            within[:, k] += block.holds(surface).sum(), mask.sum()
            found = window(mask, view.camera, factor)
            if found is not None:
                seen_by[k].append(number)
                pixels[k] += found[2] * found[3]
    for k, views in enumerate(seen_by):
        if len(views) < 2:
            raise LinprimError(
                f"block {k} of {count} is seen by {len(views)} cameras, wanted two at least: fewer blocks"
            )
    options = opened.train_options
    # Where the coarse scene has grown primitives the whole would, too, and none larger.
    grown = coarse.training_primitives().center
    state = read_checkpoint(coarse.path)
    assert state is not None
    held = np.array([[block.holds(grown, more).mean() for block in blocks] for more in (0.0, margin)])
    shares = (1 - BY_PIXELS) * held + BY_PIXELS * within / within[0].sum()
    own = apportioned(shares[0], options.max_primitives)
    parts = []
    for k, block in enumerate(blocks):
        share = float(shares[1, k])
        most = max(1, math.ceil(share * options.max_primitives))
        steps = math.ceil(options.iterations * len(seen_by[k]) / len(scene.train))
        parts.append(
            {
                "low": [_plain(x) for x in block.low],
                "high": [_plain(x) for x in block.high],
                "views": seen_by[k],
                "pixels": pixels[k],
                "work": float(work[block.holds(points)].sum() / work.sum()),
                "iterations": max(min(LEAST_STEPS, options.iterations), steps),
                "max_primitives": most,
                "own_primitives": own[k],
                "initial_primitives": min(most, math.ceil(share * options.initial_primitives)),
                "known": _plain(known_of(block.distance(grown), margin, options.max_primitives)),
            }
        )
    background = worker.result_of_folder(opened.path / FOLDER / "coarse")
    return {
        "format": FORMAT,
        "margin": margin,
        "factor": factor,
        "background": background["background"],
        "shown": background["shown"],
        "fitted": background["fitted"],
        "environment": background["environment"],
        "frozen": len(grown),
        "extent": float(state["bounds"][1]),
        "largest": max(view.camera.width * view.camera.height for view in scene.train),
        "all_pixels": sum(view.camera.width * view.camera.height for view in scene.train),
        "blocks": parts,
    }


def apportioned(shares: Sequence[float] | np.ndarray, total: int) -> list[int]:
    """A total in whole parts, in the ratio of the shares: the largest remainders are rounded up."""
    exact = total * np.asarray(shares) / np.sum(shares)
    parts = np.floor(exact).astype(int)
    parts[np.argsort(parts - exact, kind="stable")[: total - parts.sum()]] += 1
    return parts.tolist()


def known_of(distances: np.ndarray, margin: float, primitives: int) -> float:
    """How far from a block the nearest MOST_BESIDE primitives outside of it reach, its margin at least; infinite if
    there are fewer.

    Args:
        distances: (P,) of the primitives of the coarse scene from the block, 0 in it; each stands for its part of so
            many `primitives`.
    """
    outside = np.sort(distances[distances > 0])
    most = int(MOST_BESIDE * len(distances) / primitives)
    return max(margin, float(outside[most])) if most < len(outside) else math.inf


def _plain(x: float) -> float | None:
    return float(x) if math.isfinite(x) else None


def block_of(plan: dict, k: int) -> Block:
    """A block of the plan."""
    part = plan["blocks"][k]
    low, high = (
        [x if x is not None else end for x in part[name]] for name, end in (("low", -np.inf), ("high", np.inf))
    )
    return Block(tuple(low), tuple(high))


def block_task(folder: Path, run: str, block: int) -> dict:
    """Trains a block of the plan and its margin before the coarse scene, up to the first exchange."""
    opened, scene = _opened(run)
    plan = worker.result_of_folder(opened.path / FOLDER / "plan")
    own, margin = block_of(plan, block), plan["margin"]
    coarse = Run.open(opened.path / FOLDER / "coarse" / "run").training_primitives()
    return _trained(
        folder, opened, scene, plan, block, beyond(coarse, own, margin), margin, until(opened.train_options, 0), None
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
    plan = worker.result_of_folder(opened.path / FOLDER / "plan")
    own, margin = block_of(plan, block), plan["margin"]
    known = math.inf if plan["blocks"][block]["known"] is None else plan["blocks"][block]["known"]
    state = _state_of(opened.path, block, exchange - 1)
    begin = [_rows(state, is_owned(opened.path, plan, block, exchange - 1, state))]
    frozen = [beyond(Run.open(opened.path / FOLDER / "coarse" / "run").training_primitives(), own, known)]
    for other in range(len(plan["blocks"])):
        if other != block and not own.is_apart(block_of(plan, other), known):
            theirs = _state_of(opened.path, other, exchange - 1)
            center, rows = _centers(theirs), is_owned(opened.path, plan, other, exchange - 1, theirs)
            inside = own.holds(center, margin)
            begin.append(_rows(theirs, rows & inside))
            still = Run.open(block_folder(opened.path, other, exchange - 1) / "run").training_primitives()
            frozen.append(select(still, rows & ~inside & own.holds(center, known)))
    count = len(_centers(begin[0]))
    if sum(len(_centers(each)) for each in begin):
        state |= _together(begin)
    end = until(opened.train_options, exchange)
    trained = _trained(folder, opened, scene, plan, block, concatenated(frozen), known, end, state)
    return trained | {"owned": count}


def _state_of(run: Path, block: int, exchange: int) -> dict:
    state = read_checkpoint(block_folder(run, block, exchange) / "run")
    assert state is not None
    return state


def _centers(state: dict) -> np.ndarray:
    return state["parameters"]["center"].numpy()


# What a checkpoint holds for every primitive, in tables by name and as tensors.
_TABLES, _TENSORS = ("parameters", "first", "second", "gathered"), ("steps", "filter_3d")


def _rows(state: dict, keep: np.ndarray) -> dict:
    """That of some of the primitives."""
    rows = torch.from_numpy(keep)
    tables = {name: {key: value[rows] for key, value in state[name].items()} for name in _TABLES}
    return tables | {name: None if state[name] is None else state[name][rows] for name in _TENSORS}


def _together(parts: Sequence[dict]) -> dict:
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
    plan: dict,
    block: int,
    frozen: Arrays,
    known: float,
    end: float,
    begin: dict | None,
) -> dict:
    """Trains a block in folder/run up to a part of its steps, from its last checkpoint there, else from the state
    `begin`, else from the points in it and its margin. Up to `known` from the block the frozen primitives are those
    that the scene will have."""
    _prepared(opened.train_options)
    part, own = plan["blocks"][block], block_of(plan, block)
    names = ("iterations", "max_primitives", "initial_primitives")
    options = replace(
        opened.train_options,
        **{name: part[name] for name in names},
        background=plan["background"],
        evaluate_every=0,
        threads=worker.cores,
    )
    path = folder / "run"
    seen = replace(scene, train=tuple(scene.train[k] for k in part["views"]), test=())
    with locked(path, "trained into"):
        begun = (path / "config.json").exists()
        state = (read_checkpoint(path) if begun else None) or begin
        cloud = _points_of(seen, opened, plan, block, options) if state is None else None
        coarse = Run.open(opened.path / FOLDER / "coarse" / "run")
        margin, factor, still = plan["margin"], plan["factor"], tensors(frozen)
        shots = block_shots(coarse, seen.train, own, margin, known, factor, opened.similarity, options, still)
        here = replace(opened, path=path, train_options=options)
        trainer = start_trainer(seen, here, shots, options, state, cloud, plan["extent"])
        trainer.frozen = still
        trainer.control.limit_only(own.holds, part["own_primitives"], trainer.parameters, trainer.step)
        if not begun:
            about = opened.scene_path, opened.scene_options, options, opened.similarity, ops.instruction_set()
            Run.create(path, seen, *about)
        for torn in [*path.glob(".*.tmp*"), *path.glob("checkpoints/.*.tmp*")]:
            torn.unlink()
        steps = math.ceil(end * options.iterations)
        seconds, _, _ = run_steps(trainer, here, [], Progress(f"block {block}", steps, quiet=True), until=steps)
    return {"seconds": seconds, "primitives": len(trainer), "loss": trainer.loss, "train_psnr": trainer.psnr}


def _points_of(scene: Scene, run: Run, plan: dict, number: int, options: TrainOptions) -> PointCloud:
    """The scene's points in a block and its margin, filled up: at most as many in either as a training begins with that
    has the block's own primitives in the one and the others of its `options` in the other."""
    far = far_colors(scene) if plan["environment"] else None
    cloud = filled_points(scene, options.seed, np.asarray(plan["shown"]) if plan["fitted"] else None, far)
    where, block, own = (
        run.similarity.apply(cloud.xyz),
        block_of(plan, number),
        max(1, plan["blocks"][number]["own_primitives"]),
    )
    inside, beside = block.holds(where), block.holds(where, plan["margin"])
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


def is_owned(run: Path, plan: dict, block: int, exchange: int, state: dict) -> np.ndarray:
    """(N,) which primitives of a block's state after an exchange are its own. That is decided at the first; later they
    may leave it."""
    if exchange == 0:
        return block_of(plan, block).holds(_centers(state))
    return np.arange(len(_centers(state))) < worker.result_of_folder(block_folder(run, block, exchange))["owned"]


def beyond(primitives: Primitives, block: Block, margin: float) -> Arrays:
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
