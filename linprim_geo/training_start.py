"""Where a training starts: the scene with points, the run, new or reopened, and the trainer at its first step or at a
checkpoint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch

from . import ops
from .checkpoint import restore
from .effects import Choice, Decision, decide, settle, summary
from .environment import OPEN_SHARE, FarColors, far_colors, far_share, texels_for
from .errors import LinprimError
from .evidence import observe
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
from .primitives import KINDS
from .progress import Progress
from .run import Run, refuse_used
from .scene import PointCloud, Scene, load_scene
from .shots import Shot
from .structure_from_motion import prepare
from .trainer import LARGEST_PART, SMALLEST_PX, Trainer, initial_parameters

# Primitives at the start, as a share of the most there may be: from points on surfaces, and from random ones.
SFM_START, RANDOM_START = 0.8, 0.25
# Triangulated points fewer than this leave too much of a scene empty.
FEW_POINTS = 500
# A backdrop is plain where this share of all border pixels lies this near to their median colour, per channel.
BACKDROP_SHARE, BACKDROP_TOLERANCE = 0.8, 0.1


def with_points(scene: Scene, options: TrainOptions, log: Callable[[str], None]) -> Scene:
    """The scene with points to start from: its own, triangulated under the known poses, or random where cameras look.

    A scene with alpha and no points starts inside the visual hull. Without alpha, features are matched and
    triangulated; if they are few, random points in the common field of view fill up.
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


def begin_run(
    scene: Path,
    run_path: Path,
    scene_options: SceneOptions,
    options: TrainOptions,
    effects: Choice,
    progress: Progress,
) -> tuple[Run, Scene, list[Decision]]:
    """A new run, whose folder is not made yet, its scene with points to start from, and what was decided about its
    effects.

    Raises:
        LinprimError: something is at `run_path` already, or the scene or an option cannot be used.
    """
    refuse_used(run_path)
    decisions, loaded, scene_options, options = decided_scene(scene, scene_options, options, effects, progress.note)
    if decisions:
        progress.note(summary(decisions))
    run = Run(run_path, scene, scene_options, options, scene_normalization(loaded), loaded.unit)
    return run, loaded, decisions


def reopen_run(
    scene: Path, run_path: Path, scene_options: SceneOptions, options: TrainOptions, progress: Progress
) -> tuple[Run, Scene]:
    """An existing run and its scene; options that were given and differ from the run's, but for `threads`, are named as
    ignored.

    Raises:
        LinprimError: not a run folder, a file in it is damaged, or its scene is neither where it was nor at `scene`.
    """
    opened = Run.open(run_path)
    if scene.resolve() != opened.scene_path:
        opened = opened.with_scene_at(scene)
    ignored = [
        "--" + field.name.replace("_", "-")
        for given, own in ((scene_options, opened.scene_options), (options, opened.train_options))
        for field in fields(given)
        if field.name != "threads" and getattr(given, field.name) not in (field.default, getattr(own, field.name))
    ]
    if ignored:
        progress.note(f"--resume goes on with the run's own options: {', '.join(ignored)} ignored")
    if opened.instruction_set not in ("", ops.instruction_set()):
        progress.note(
            f"begun with {opened.instruction_set} kernels and going on with {ops.instruction_set()}: the last "
            "bits will differ"
        )
    progress.total = opened.train_options.iterations
    return replace(opened, train_options=replace(opened.train_options, threads=options.threads)), opened.scene()


def late_terms(run: Run, scene: Scene, shots: list[Shot], progress: Progress) -> GeometryTerms | None:
    """The late terms for geometry that have a weight, of a scene with points; None if none has."""
    options = run.train_options
    if not any(getattr(options, name) > 0 for name in GEOMETRY_WEIGHTS):
        return None
    assert scene.points is not None
    evidence = gather_evidence(scene, options, run.similarity, progress.note)
    terms = GeometryTerms(options, shots, evidence, run.similarity.apply(scene.points.xyz))
    if terms.sources is not None and not any(terms.sources):
        progress.note("--patches: no two views see the same places from angles that suit it, so it does nothing")
    return terms


@dataclass(frozen=True)
class Background:
    """What training puts behind everything: a `color` (3,) float32 in [0, 1], which is `fitted`, or replaced by a
    `random` one in each step or by an `environment`, which begins with the photographs' colours at infinity, `far`."""

    color: torch.Tensor
    fitted: bool = False
    random: bool = False
    environment: bool = False
    far: FarColors | None = None


def chosen_background(text: str, scene: Scene, shots: list[Shot], begun: bool | None = None) -> Background:
    """What the option's text stands for. Of a training that goes on, `begun` says whether it has an environment: that
    has its colours.

    Without alpha a random background makes everything opaque: a fitted one would let a wall of its colour become
    transparent. It is fitted only where photographs have a plain backdrop, and an environment is trained only where
    they say that a scene is open.

    Raises:
        LinprimError: the text is no name and not three numbers in [0, 1].
    """
    named = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
    has_alpha = shots[0].alpha is not None
    far = None
    if text == "auto":
        text = "random"
        if begun:
            text = "environment"
        elif not has_alpha and plain_border(shots) > BACKDROP_SHARE:
            text = "fitted"
        elif not has_alpha and begun is None:
            far = far_colors(scene)
            text = "environment" if far_share(far, scene) >= OPEN_SHARE else "random"
    if text == "random":
        return Background(torch.ones(3) if has_alpha else torch.from_numpy(_mean_color(shots)), random=True)
    if text == "environment":
        if has_alpha:
            raise LinprimError("--background environment: masks or alpha say already what is background")
        far = far_colors(scene) if far is None and begun is None else far
        return Background(torch.from_numpy(_mean_color(shots)), environment=True, far=far)
    if text == "fitted":
        return Background(torch.from_numpy(np.median(_border_colors(shots), 0).astype(np.float32)), fitted=True)
    try:
        color = named[text] if text in named else tuple(float(x) for x in text.split(","))
    except ValueError:
        color = ()
    if len(color) != 3 or not all(0 <= x <= 1 for x in color):
        raise LinprimError(
            f"--background is {text!r}, wanted auto, fitted, environment, random, black, white, or three numbers "
            "in [0,1] such as 0.5,0.5,1"
        )
    return Background(torch.tensor(color, dtype=torch.float32))


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


def filled_points(scene: Scene, seed: int, backdrop: np.ndarray | None, far: FarColors | None = None) -> PointCloud:
    """The scene's points, filled up (`fill_points`) unless they are random ones, which lie on no surface."""
    assert scene.points is not None
    return scene.points if isinstance(scene.points, VolumePoints) else fill_points(scene, seed, backdrop, far)


def start_trainer(
    scene: Scene,
    run: Run,
    shots: list[Shot],
    options: TrainOptions,
    state: dict | None,
    cloud: PointCloud | None = None,
    largest: float | None = None,
) -> Trainer:
    """A trainer at step 0, or at the step of a checkpoint's `state`.

    Args:
        scene: with points to start from; those of a checkpoint need none.
        shots: its training views in the training frame.
        cloud: the points to start from; default: `filled_points` of the scene.
        largest: extent that a primitive may have, in the training frame; default: by what the points reach.

    Raises:
        LinprimError: the background is none, or the checkpoint does not fit the options.
    """
    focal = float(np.median([max(s.camera.fx, s.camera.fy) for s in shots]))
    centers = np.stack([s.camera.center for s in shots])
    begun = None if state is None else "environment" in state.get("parameters", {})
    behind = chosen_background(options.background, scene, shots, begun)
    surface = state is None and not isinstance(scene.points, VolumePoints)
    if state is not None:
        xyz, rgb, radius = np.zeros((4, 3)), np.zeros((4, 3)), 1.0  # replaced below
    else:
        if cloud is None:
            cloud = filled_points(scene, options.seed, behind.color.numpy() if behind.fitted else None, behind.far)
        cloud = initial_cloud(cloud, options)
        xyz, rgb = run.similarity.apply(cloud.xyz), cloud.rgb
        middle = np.median(xyz, 0)
        reach = np.linalg.norm(xyz - middle, axis=1)
        radius = max(float(np.percentile(reach, 98)), 0.2 * float(np.linalg.norm(centers - middle, axis=1).max()), 1e-3)
    smallest = SMALLEST_PX * CAMERA_DISTANCE / focal
    like = KINDS[options.primitive].size
    largest = like * LARGEST_PART * radius if largest is None else largest
    bounds = (like * smallest, max(largest, like * 4 * smallest))
    parameters = initial_parameters(xyz, rgb, options.sh_degree, options.seed, bounds, options.primitive)
    if surface and parameters["log_extent"].shape[1] == 3:
        _lay_down(parameters, xyz, options.seed, bounds[0])
    log_gain = None
    if options.exposure == "gain" and state is None:
        seen = observe(scene, options.seed, views=len(shots))
        log_gain = None if seen is None else seen.log_gains[0]
    environment = None
    if behind.environment:
        size = texels_for([shot.camera for shot in shots])
        environment = (
            torch.zeros(6, size, size, 3) if behind.far is None else behind.far.start(size)
        )  # zeros: replaced below
    trainer = Trainer(
        shots,
        parameters,
        options,
        bounds,
        behind.color,
        behind.fitted,
        behind.random,
        log_gain=log_gain,
        environment=environment,
    )
    if state is not None:
        restore(trainer, state, run.path / "checkpoints")
    return trainer


def _lay_down(parameters: dict[str, torch.Tensor], xyz: np.ndarray, seed: int, smallest: float) -> None:
    """Lays primitives on the planes of their points, as thin across as these are flat, at least twice the smallest
    extent.

    A ball round a point of a plain wall stands out from it by its radius, and no photograph says that it does not.
    """
    rotation, flat = local_planes(xyz, seed)
    parameters["rotation"].copy_(torch.from_numpy(rotation))
    across = parameters["log_extent"][:, 2]
    thin = across + torch.from_numpy(np.log(flat)).float()
    across.copy_(torch.maximum(thin, across.clamp_max(float(np.log(2 * smallest)))))
