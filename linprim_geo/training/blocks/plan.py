"""The plan of a training in blocks: how space, primitives and photographs are shared out."""

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
# Goes up whenever tasks need what those of before have not left.
FORMAT = 4
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


@dataclass(frozen=True)
class Part:
    """A block and its share. Steps, primitives and photographs are those that it and its margin are trained with."""

    block: Block
    views: tuple[int, ...]  # training views of the scene that show it
    pixels: int  # of the windows of these views
    work: float  # its part of the whole's, 0 to 1
    iterations: int
    max_primitives: int
    own_primitives: int  # at most in it without its margin
    initial_primitives: int
    exact_radius: float  # so far from it others stand in full; may be infinite


@dataclass(frozen=True)
class Plan:
    """What `plan_task` has decided. Lengths are the training frame's."""

    margin: float
    factor: int  # pixels of the whole per pixel of the coarse scene
    background: str  # as --background says it
    shown: tuple[float, ...]  # (3,) the colour behind everything
    fitted: bool
    environment: bool
    frozen: int  # primitives of the coarse scene
    extent: float  # the largest that a primitive may have
    largest: int  # pixels of the largest photograph
    all_pixels: int  # of all training photographs
    blocks: tuple[Part, ...]

    def to_json(self) -> dict:
        """The table that the plan's task leaves; infinite numbers are null."""
        parts = []
        for part in self.blocks:
            plain = {entry.name: getattr(part, entry.name) for entry in fields(part) if entry.name != "block"}
            ends = {name: [_json_number(x) for x in getattr(part.block, name)] for name in ("low", "high")}
            parts.append(ends | plain | {"views": list(part.views), "exact_radius": _json_number(part.exact_radius)})
        plain = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return {"format": FORMAT} | plain | {"shown": list(self.shown), "blocks": parts}

    @staticmethod
    def from_json(saved: dict, run: Path) -> Plan:
        """Reads what `to_json` made.

        Raises:
            LinprimError: it is of another format.
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
    """The plan of a run in blocks.

    Raises:
        LinprimError: there is none, or it is of another version.
    """
    return Plan.from_json(worker.result_of_folder(run / FOLDER / "plan"), run)


def save_points(path: Path, cloud: PointCloud) -> None:
    """Writes the points that a scene starts from."""
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, xyz=cloud.xyz, rgb=cloud.rgb, volume=isinstance(cloud, VolumePoints))


def load_points(path: Path) -> PointCloud:
    """Reads what `save_points` wrote.

    Raises:
        LinprimError: it is damaged.
    """
    xyz, rgb, volume = read_named(path, {"xyz": ((None, 3), "f"), "rgb": ((None, 3), "u"), "volume": ((), "b")})
    if len(xyz) != len(rgb):
        raise LinprimError(f"{path}: holds {len(xyz)} points and {len(rgb)} colours, wanted as many")
    return (VolumePoints if volume else PointCloud)(xyz, rgb)


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
    seen = replace(scene_options, downscale=factor * scene.downscale, views=views)
    return replace(run, path=run.path / FOLDER / "coarse" / "run", scene_options=seen, train_options=coarse)


def _opened(run: str) -> tuple[Run, Scene]:
    """The run and its scene with the points to start from."""
    opened = Run.open(run)
    return opened, replace(opened.scene(), points=load_points(opened.path / FOLDER / "points.npz"))


def _prepared(options: TrainOptions) -> None:
    torch.set_num_threads(1)
    ops.set_threads(worker.cores)


def plan_task(folder: Path, run: str, count: int) -> dict:
    """Splits space, and finds the views that show each block. Returns what `read_plan` reads."""
    opened, scene = _opened(run)
    _prepared(opened.train_options)
    coarse = Run.open(opened.path / FOLDER / "coarse" / "run")
    factor = int(coarse.scene_options.downscale) // scene.downscale
    assert scene.points is not None
    points = opened.similarity.apply(scene.points.xyz)

    def views_with_depth() -> Iterator[tuple[View, Camera, np.ndarray]]:
        """Rendered twice: depths of all views take more memory than there may be."""
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
    """The views that show each block, the pixels of its windows in them, and (2, B) how much of the coarse scene they
    show in it, and in it and its margin."""
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
    """A total in whole parts, in the ratio of the shares: the largest remainders are rounded up."""
    exact = total * np.asarray(shares) / np.sum(shares)
    parts = np.floor(exact).astype(int)
    parts[np.argsort(parts - exact, kind="stable")[: total - parts.sum()]] += 1
    return parts.tolist()


def exact_radius_of(distances: np.ndarray, margin: float, primitives: int) -> float:
    """How far from a block the nearest MOST_BESIDE primitives outside of it reach, its margin at least; infinite if
    there are fewer.

    Args:
        distances: (P,) of the primitives of the coarse scene from the block, 0 in it; each stands for its part of so
            many `primitives`.
    """
    outside = np.sort(distances[distances > 0])
    most = int(MOST_BESIDE * len(distances) / primitives)
    return max(margin, float(outside[most])) if most < len(outside) else math.inf


def _json_number(x: float) -> float | None:
    return float(x) if math.isfinite(x) else None
