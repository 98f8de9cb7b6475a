"""Plan a training in blocks: how space, primitives, steps and photographs are divided."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch

from linprim_geo.base.arrays import read_named
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write
from linprim_geo.base.options import TrainOptions
from linprim_geo.capture.types import PointCloud, Scene, View
from linprim_geo.geometry.boxes import Block, margin_of, point_work, split_space, surface_points, window
from linprim_geo.geometry.camera import Camera
from linprim_geo.jobs import worker
from linprim_geo.kernels import ops
from linprim_geo.points.initial_points import VolumePoints
from linprim_geo.runs.run import Run
from linprim_geo.training.blocks.windows import small_depths
from linprim_geo.training.checkpoint import read_checkpoint

FOLDER = "blocks"
# Version of the files in RUN/blocks. Raised whenever tasks need something that earlier versions did not write.
FORMAT = 4
# The coarse model: its downscale factor, its shares of the steps and primitives of the whole scene, its largest numbers
# of primitives and views, and the smallest side of a photograph in pixels after downscaling.
COARSE_DOWNSCALE, COARSE_STEPS, COARSE_PRIMITIVES = 2, 0.25, 0.25
MOST_COARSE_PRIMITIVES, MOST_COARSE_VIEWS, LEAST_SIDE = 20_000, 1000, 32
# Blocks receive primitives in proportion to those that the coarse model has grown there, except for this share, which
# is divided in proportion to the pixels that show each block: the full training has four times as many steps to add
# primitives where the pixels need them.
BY_PIXELS = 0.25
# Smallest number of steps of a block, or all steps if the whole training has fewer.
LEAST_STEPS = 300
# Blocks exchange their primitives at these shares of the steps that remain once growth has ended. After an exchange,
# other blocks' primitives replace the coarse model around a block, the nearest first, up to about MOST_BESIDE
# primitives including those trained in the margin; beyond them the coarse model remains.
EXCHANGES, MOST_BESIDE = (0.125, 0.5, 0.8125), 100_000


@dataclass(frozen=True)
class Part:
    """A block and its share of the training. Steps, primitives and photographs are those used for the block with its
    margin."""

    block: Block
    views: tuple[int, ...]  # indices of the training views that show it
    pixels: int  # sum over the crops of these views that show it
    work: float  # its share of the `point_work` of all points, 0 to 1
    iterations: int
    max_primitives: int
    own_primitives: int  # limit for the block without its margin
    initial_primitives: int
    exact_radius: float  # distance up to which other blocks' primitives replace the coarse model; may be infinite


@dataclass(frozen=True)
class Plan:
    """The result of `plan_task`. Lengths are in the training frame."""

    margin: float
    factor: int  # downscale factor of the coarse model relative to the whole
    background: str  # value of --background for the blocks
    shown: tuple[float, ...]  # (3,) background colour
    fitted: bool
    environment: bool
    frozen: int  # number of primitives of the coarse model
    extent: float  # largest extent of a primitive
    largest: int  # pixels of the largest photograph
    all_pixels: int  # of all training photographs
    blocks: tuple[Part, ...]

    def to_json(self) -> dict:
        """Return the plan as a JSON table; infinite numbers become null."""
        parts = []
        for part in self.blocks:
            plain = {entry.name: getattr(part, entry.name) for entry in fields(part) if entry.name != "block"}
            ends = {name: [_json_number(x) for x in getattr(part.block, name)] for name in ("low", "high")}
            parts.append(ends | plain | {"views": list(part.views), "exact_radius": _json_number(part.exact_radius)})
        plain = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return {"format": FORMAT} | plain | {"shown": list(self.shown), "blocks": parts}

    @staticmethod
    def from_json(saved: dict, run: Path) -> Plan:
        """Read a plan from the result of `to_json`.

        Raises:
            LinprimError: it is of another format version.
        """
        if saved.get("format") != FORMAT:
            raise LinprimError(f"{run}: was begun in blocks by another version of linprim-geo, wanted a new folder")
        parts = []
        for part in saved["blocks"]:
            low, high = (
                tuple(end if x is None else x for x in part[name])
                for name, end in (("low", -math.inf), ("high", math.inf))
            )
            plain = {entry.name: part[entry.name] for entry in fields(Part) if entry.name != "block"}
            exact_radius = math.inf if part["exact_radius"] is None else part["exact_radius"]
            parts.append(
                Part(Block(low, high), **plain | {"views": tuple(part["views"]), "exact_radius": exact_radius})
            )
        plain = {entry.name: saved[entry.name] for entry in fields(Plan)}
        return Plan(**plain | {"shown": tuple(saved["shown"]), "blocks": tuple(parts)})


def read_plan(run: Path) -> Plan:
    """Return the plan of a run in blocks.

    Raises:
        LinprimError: there is none, or it is of another version.
    """
    return Plan.from_json(worker.result_of_folder(run / FOLDER / "plan"), run)


def save_points(path: Path, cloud: PointCloud) -> None:
    """Write a scene's initial points."""
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, xyz=cloud.xyz, rgb=cloud.rgb, volume=isinstance(cloud, VolumePoints))


def load_points(path: Path) -> PointCloud:
    """Read points that `save_points` wrote.

    Raises:
        LinprimError: the file is damaged.
    """
    xyz, rgb, volume = read_named(path, {"xyz": ((None, 3), "f"), "rgb": ((None, 3), "u"), "volume": ((), "b")})
    if len(xyz) != len(rgb):
        raise LinprimError(f"{path}: holds {len(xyz)} points and {len(rgb)} colours, wanted as many")
    return (VolumePoints if volume else PointCloud)(xyz, rgb)


def coarse_of(run: Run, scene: Scene) -> Run:
    """Return the run of the coarse model: the whole scene with fewer pixels, views, steps and primitives. It represents
    the parts of the scene that a block does not hold."""
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
    seen = replace(scene_options, downscale=factor * scene.downscale, views=views)
    return replace(run, path=run.path / FOLDER / "coarse" / "run", scene_options=seen, train_options=coarse)


def _opened(run: str) -> tuple[Run, Scene]:
    """Return the run, and its scene with the initial points."""
    opened = Run.open(run)
    return opened, replace(opened.scene(), points=load_points(opened.path / FOLDER / "points.npz"))


def _prepared(options: TrainOptions) -> None:
    torch.set_num_threads(1)
    ops.set_threads(worker.cores)


def plan_task(folder: Path, run: str, count: int) -> dict:
    """Split space into blocks and find the views that show each. Return the table that `read_plan` reads."""
    opened, scene = _opened(run)
    _prepared(opened.train_options)
    coarse = Run.open(opened.path / FOLDER / "coarse" / "run")
    factor = int(coarse.scene_options.downscale) // scene.downscale
    assert scene.points is not None
    points = opened.similarity.apply(scene.points.xyz)

    def views_with_depth() -> Iterator[tuple[View, Camera, np.ndarray]]:
        """Yield each view with its small camera and depth map.

        The maps are rendered once per iteration, because keeping those of all views could exceed the memory.
        """
        for view, (camera, depth) in zip(scene.train, small_depths(coarse, scene.train, factor), strict=True):
            yield view, camera, depth

    work = point_work(
        points, ((camera, depth, view.camera.width * view.camera.height) for view, camera, depth in views_with_depth())
    )
    used = work > 0
    if not used.any():
        raise LinprimError(f"{scene.root}: no camera sees a point of the scene, so no block can be made")
    blocks = split_space(points[used], work[used], count)
    margin = margin_of(blocks, points[used])
    seen_by, pixels, within = _visible_points(blocks, views_with_depth(), margin, factor)
    options = opened.train_options
    # The full training is expected to add primitives where the coarse model has them, and to make none larger.
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
            Part(
                block=block,
                views=tuple(seen_by[k]),
                pixels=pixels[k],
                work=float(work[block.holds(points)].sum() / work.sum()),
                iterations=max(min(LEAST_STEPS, options.iterations), steps),
                max_primitives=most,
                own_primitives=own[k],
                initial_primitives=min(most, math.ceil(share * options.initial_primitives)),
                exact_radius=exact_radius_of(block.distance(grown), margin, options.max_primitives),
            )
        )
    behind = worker.result_of_folder(opened.path / FOLDER / "coarse")
    return Plan(
        margin=margin,
        factor=factor,
        background=behind["background"],
        shown=tuple(behind["shown"]),
        fitted=behind["fitted"],
        environment=behind["environment"],
        frozen=len(grown),
        extent=float(state["bounds"][1]),
        largest=max(view.camera.width * view.camera.height for view in scene.train),
        all_pixels=sum(view.camera.width * view.camera.height for view in scene.train),
        blocks=tuple(parts),
    ).to_json()


def _visible_points(
    blocks: Sequence[Block], views_with_depth: Iterable[tuple[View, Camera, np.ndarray]], margin: float, factor: int
) -> tuple[list[list[int]], list[int], np.ndarray]:
    """Return the views that show each block, the pixels of its crops in them, and (2, B) the number of visible surface
    pixels of the coarse model in each block, without and with its margin."""
    seen_by: list[list[int]] = [[] for _ in blocks]
    pixels, within = [0] * len(blocks), np.zeros((2, len(blocks)))
    for number, (view, camera, depth) in enumerate(views_with_depth):
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
                f"block {k} of {len(blocks)} is seen by {len(views)} cameras, wanted two at least: fewer blocks"
            )
    return seen_by, pixels, within


def apportioned(shares: Sequence[float] | np.ndarray, total: int) -> list[int]:
    """Divide a total into whole numbers in the ratio of the shares; the largest remainders are rounded up."""
    exact = total * np.asarray(shares) / np.sum(shares)
    parts = np.floor(exact).astype(int)
    parts[np.argsort(parts - exact, kind="stable")[: total - parts.sum()]] += 1
    return parts.tolist()


def exact_radius_of(distances: np.ndarray, margin: float, primitives: int) -> float:
    """Return the distance from a block within which the nearest MOST_BESIDE primitives outside of it lie, at least the
    margin; infinite if there are fewer.

    Args:
        distances: (P,) distances of the coarse model's primitives from the block, 0 inside; each represents an equal
            share of `primitives` of the full model.
    """
    outside = np.sort(distances[distances > 0])
    most = int(MOST_BESIDE * len(distances) / primitives)
    return max(margin, float(outside[most])) if most < len(outside) else math.inf


def _json_number(x: float) -> float | None:
    return float(x) if math.isfinite(x) else None
