"""Set up a training: read the scene and its initial points, create or reopen the run, and build the trainer at step 0
or from a checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import torch

from linprim_geo.base.kinds import KINDS
from linprim_geo.base.options import (
    GEOMETRY_WEIGHTS,
    SceneOptions,
    TrainOptions,
    changed_options,
    check_train_options,
    flag_of,
)
from linprim_geo.base.progress import Progress
from linprim_geo.capture.load import load_scene, resolved_downscale, settled_folders
from linprim_geo.capture.types import PointCloud, Scene
from linprim_geo.geometry.environment_map import texels_for
from linprim_geo.imaging.decoded_photos import DecodedPhotos
from linprim_geo.kernels import ops
from linprim_geo.points.initial_points import (
    CAMERA_DISTANCE,
    VolumePoints,
    local_planes,
    scene_normalization,
)
from linprim_geo.points.photo_evidence import observe
from linprim_geo.points.start_points import filled_points, initial_cloud, with_points
from linprim_geo.runs.run import Run, refuse_used
from linprim_geo.stereo.poses.adjust_poses import adjusted_scene
from linprim_geo.stereo.poses.refine_found_poses import prepare
from linprim_geo.training.background import chosen_background
from linprim_geo.training.checkpoint import restore
from linprim_geo.training.effects import Choice, Decision, decide, settle, summary
from linprim_geo.training.step.geometry_terms import GeometryTerms, gather_evidence
from linprim_geo.training.step.parameters import initial_parameters
from linprim_geo.training.step.trainer import LARGEST_PART, SMALLEST_PX, Trainer
from linprim_geo.training.step.training_images import TrainingImage
from linprim_geo.training.stereo_surfaces import NO_SURFACES, Surfaces


def decided_scene(
    path: Path, scene_options: SceneOptions, options: TrainOptions, choice: Choice, log: Callable[[str], None]
) -> tuple[list[Decision], Scene, SceneOptions, TrainOptions]:
    """Read a scene, decide about its effects, and read it again if a decision changes how it is read.

    Returns: the decisions, the scene with initial points, and both option objects with the decided values and a numeric
    `downscale`.
    """

    decoded = DecodedPhotos()

    def read(how: SceneOptions) -> Scene:
        scene = load_scene(path, how, decoded=decoded)
        if how.poses == "auto":
            scene = adjusted_scene(scene, options.seed, threads=options.threads, log=log)
        return with_points(scene, options, log)

    prepare(path, scene_options, threads=options.threads, log=log)
    scene = read(scene_options)
    scene_options = replace(scene_options, downscale=resolved_downscale(scene, scene_options, log))
    if choice.mode == "none" and not choice.asked:
        return [], scene, scene_options, options
    decisions = decide(scene, scene_options, options, choice)
    settled, options = settle(scene_options, options, decisions)
    check_train_options(options)
    if not scene.has_alpha:  # without masks the option changes nothing, so do not read the scene again for it
        settled = replace(settled, masks=scene_options.masks)
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
    """Return a new run, its scene with initial points, and the decisions about its effects. The run's folder is not
    created yet.

    Raises:
        LinprimError: `run_path` exists already, or the scene or an option cannot be used.
    """
    refuse_used(run_path)
    decisions, loaded, scene_options, options = decided_scene(scene, scene_options, options, effects, progress.note)
    if decisions:
        progress.note(summary(decisions))
    scene_options = settled_folders(scene_options, loaded.root)
    run = Run(run_path, scene, scene_options, options, scene_normalization(loaded), loaded.unit)
    return run, loaded, decisions


def reopen_run(
    scene: Path,
    run_path: Path,
    scene_options: SceneOptions,
    options: TrainOptions,
    progress: Progress,
    effects: Choice | None = None,
    ignored: Sequence[str] = (),
) -> tuple[Run, Scene]:
    """Return an existing run and its scene.

    The run keeps its own options. Given options that differ from them (except `threads`), a choice of effects, and the
    names in `ignored` are reported as ignored.

    Raises:
        LinprimError: not a run folder, a file in it is damaged, or its scene is neither at its recorded path nor at
            `scene`.
    """
    opened = Run.open(run_path)
    if scene.resolve() != opened.scene_path:
        opened = opened.with_scene_at(scene)
    loaded, effects = opened.scene(), effects or Choice("none")
    kept = [settled_folders(each, loaded.root) for each in (scene_options, opened.scene_options)]
    ignored = [*ignored, *["--effects"] * (effects.mode != "none"), *["--effect"] * bool(effects.asked)]
    ignored += [
        flag_of(entry.name)
        for given, own in (kept, (options, opened.train_options))
        for entry in fields(given)
        if entry in changed_options(given) or entry.name in effects.given
        if entry.name != "threads" and getattr(given, entry.name) != getattr(own, entry.name)
    ]
    if ignored:
        progress.note(f"--resume goes on with the run's own options: {', '.join(ignored)} ignored")
    if opened.instruction_set not in ("", ops.instruction_set()):
        progress.note(
            f"begun with {opened.instruction_set} kernels and going on with {ops.instruction_set()}: the last "
            "bits will differ"
        )
    progress.total = opened.train_options.iterations
    return replace(opened, train_options=replace(opened.train_options, threads=options.threads)), loaded


def geometry_terms(
    run: Run, scene: Scene, images: list[TrainingImage], surfaces: Surfaces, progress: Progress
) -> GeometryTerms | None:
    """Return the geometry terms of the loss that have a weight, or None if there are none."""
    options = run.train_options
    if not surfaces.maps and not any(getattr(options, name) > 0 for name in GEOMETRY_WEIGHTS):
        return None
    return GeometryTerms(options, images, gather_evidence(scene, options, run.similarity, progress.note, surfaces.maps))


def start_trainer(
    scene: Scene,
    run: Run,
    images: list[TrainingImage],
    options: TrainOptions,
    state: dict | None,
    cloud: PointCloud | None = None,
    largest: float | None = None,
    surfaces: Surfaces = NO_SURFACES,
) -> Trainer:
    """Build a trainer at step 0, or at the step of a checkpoint's `state`.

    Args:
        scene: with initial points; not needed with a checkpoint.
        images: its training views in the training frame.
        cloud: initial points; default: `filled_points` of the scene and of `surfaces`.
        largest: largest extent of a primitive, in the training frame; default: from the radius of the points.
        surfaces: result of stereo: points and whether there is a sky.

    Raises:
        LinprimError: the background option is invalid, or the checkpoint does not fit the options.
    """
    focal = float(np.median([max(s.camera.fx, s.camera.fy) for s in images]))
    centers = np.stack([s.camera.center for s in images])
    begun = None if state is None else "environment" in state.get("parameters", {})
    behind = chosen_background(options.background, scene, images, begun, surfaces.sky)
    surface = state is None and not isinstance(scene.points, VolumePoints)
    if state is not None:
        xyz, rgb, radius = np.zeros((4, 3)), np.zeros((4, 3)), 1.0  # replaced by the checkpoint's below
    else:
        if cloud is None:
            backdrop = behind.color.numpy() if behind.fitted else None
            cloud = filled_points(scene, options.seed, backdrop, behind.far, surfaces.points)
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
        seen = observe(scene, options.seed, views=len(images))
        log_gain = None if seen is None else seen.log_gains[0]
    environment = None
    if behind.environment:
        size = texels_for([image.camera for image in images])
        environment = (
            torch.zeros(6, size, size, 3) if behind.far is None else behind.far.start(size)
        )  # zeros: replaced by the checkpoint's
    trainer = Trainer(
        images,
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
    """Flatten initial primitives onto the local planes of their points, along the third axis.

    They become as thin as the points are flat locally, but at least twice the smallest extent. A round primitive on a
    plain wall would stick out by its radius, and on a wall without texture no photograph contradicts that.
    """
    rotation, flat = local_planes(xyz, seed)
    parameters["rotation"].copy_(torch.from_numpy(rotation))
    across = parameters["log_extent"][:, 2]
    thin = across + torch.from_numpy(np.log(flat)).float()
    across.copy_(torch.maximum(thin, across.clamp_max(float(np.log(2 * smallest)))))
