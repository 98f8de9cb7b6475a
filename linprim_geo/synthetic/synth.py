"""Synthetic captures: posed images, depth, normals, masks and SfM-like points of a mesh with a known surface."""

from __future__ import annotations

import os
import shutil
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from linprim_geo.base.cores import usable_cores
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import write_json
from linprim_geo.base.options import with_changes
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.feature_points import ObservedPoints
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.synthetic import camera_paths as campath
from linprim_geo.synthetic.built_in import SHAPES, TEXTURES
from linprim_geo.synthetic.camera_effects import with_camera
from linprim_geo.synthetic.cameras import place_cameras
from linprim_geo.synthetic.environment import synthetic_environment
from linprim_geo.synthetic.files import frame_entry, prepare_folder, publish_folder, shared_keys
from linprim_geo.synthetic.options import SynthOptions, background_color, check_together
from linprim_geo.synthetic.photos import photo_name
from linprim_geo.synthetic.points import sample_points, write_colmap, write_points
from linprim_geo.synthetic.points_from_photos import photographed_colors, photographed_points
from linprim_geo.synthetic.pose_errors import SEED as POSE_SEED
from linprim_geo.synthetic.pose_errors import reported
from linprim_geo.synthetic.realism.render import load_mitsuba
from linprim_geo.synthetic.realism.scenes import TracedScene, refuse_own, seen_faces
from linprim_geo.synthetic.rendering import Backdrop, Renderer, depth_unit, render_views, without_threads
from linprim_geo.synthetic.tabletop import on_table
from linprim_geo.synthetic.textured import TexturedMesh, load_textured

REFINE = 0.01
"""Longest edges of reference.ply, in units of the diagonal; its vertices carry the colours."""


def synthesize(
    out: str | os.PathLike,
    options: SynthOptions | None = None,
    *,
    shape: str | None = None,
    mesh: str | os.PathLike | TexturedMesh | None = None,
    overwrite: bool = False,
    quiet: bool = False,
    **changes: Any,
) -> dict:
    """Render a capture of a built-in scene or of a mesh to the folder `out`, with ground truth.

    Files: `train/000.png ...` and `test/`; `depth/`, `normal/` and `masks/` with the same two folders in
    each; `transforms_train.json` and `transforms_test.json` (nerfstudio's keys, OpenGL camera-to-world);
    `sparse/0`, a COLMAP model of the training views and the points with their observations (image names
    relative to `out`); `points3D.ply`; `reference.ply`, the surface with vertex colours; `synth.json`, all
    parameters. Frame and unit are the mesh's own; metres for a path-traced scene. If cameras are written with
    errors, `truth_cameras.json` has the true ones.

    Images are the mean of supersample^2 rays per pixel, in the stored (sRGB) values. Depth is along the
    optical axis, exactly at the pixel centre, rounded to `depth_unit_scale_factor` (at most 1/30000 of the
    largest depth) as uint16, 0 for no surface; or float32 as `.npy`. Normals are geometric, in world axes,
    towards the camera, (n + 1) / 2 in 8 bits, black for no surface. Masks are the coverage in 8 bits, equal to the
    images' alpha. With an opaque background or an environment, the images already include it, and the coverage is
    in `truth_masks/`, so that it is not applied twice.

    Args:
        out: folder to create; it must be empty or not exist. Everything is written to a temporary folder beside
            it, which is renamed at the end.
        options: the settings of the photographs.
        shape: `cad`, `smooth`, `room`, `wires` or `hall`. Give `shape` or `mesh`, not both; the default is `cad`.
        mesh: a mesh file with texture or vertex colours, or a `TexturedMesh`.
        overwrite: replace `out` if it was made by `synth` before.
        quiet: print no progress to stderr.
        changes: fields of `options` by name, such as `views=16`.

    Returns:
        Folder, counts, size and seconds.

    Raises:
        LinprimError: an option is invalid, the mesh cannot be read, `out` is not empty or cannot be
        written.
    """
    start = time.perf_counter()
    out = Path(out)
    options = with_camera(with_changes(SynthOptions, options, changes))
    plan = _plan(shape, mesh, options)
    temporary = prepare_folder(out, overwrite)
    try:
        report = _write_capture(plan, options, temporary, quiet)
        report = {"output": str(out), **report}
        write_json(temporary / "synth.json", report)
        publish_folder(temporary, out)
    except BaseException as error:
        shutil.rmtree(temporary, ignore_errors=True)
        if isinstance(error, OSError):
            raise LinprimError(f"{out}: cannot be written ({error.strerror or error}); nothing was kept") from error
        raise
    return {**report, "seconds": round(time.perf_counter() - start, 3)}


@dataclass(frozen=True)
class _Plan:
    """The surface, the cameras and all other settings that are fixed before anything is rendered or written."""

    surface: TexturedMesh
    caster: RayCaster
    backdrop: Backdrop
    path: str
    fov: float
    train: list[Camera]
    test: list[Camera]
    distance: float | None
    gains: np.ndarray
    workers: int


def _plan(shape, mesh, options: SynthOptions) -> _Plan:
    workers = options.threads or usable_cores()
    gains = _gains(options)
    if options.realism:
        refuse_own(options.realism, options)
        figure = None if mesh is None else _surface(None, mesh, 1.0)
        if shape is not None:
            raise LinprimError(f"--scene {shape!r} and --realism {options.realism} are both given, wanted one of them")
        load_mitsuba(options.tracer, workers)
        traced = TracedScene(options.realism, figure, options)
        check_together(options, traced.path, transparent=False)
        caster = RayCaster(traced.surface.vertices, traced.surface.faces, threads=workers)
        cameras = traced.train, traced.test
        return _Plan(traced.surface, caster, traced, traced.path, traced.fov, *cameras, None, gains, workers)
    subject = _surface(shape, mesh, options.detail * TEXTURES[options.texture])
    path = options.path or ("arc" if options.table else subject.path)
    backdrop = _backdrop(options, inside=path == "inside-out")
    check_together(options, path, transparent=backdrop is None)
    surface = on_table(subject, options.table, options.seed) if options.table else subject
    caster = RayCaster(surface.vertices, surface.faces, threads=workers)
    fov = options.fov or (75.0 if path == "inside-out" else 45.0)
    train, test, distance = place_cameras(subject, caster, options, path, fov)
    return _Plan(surface, caster, backdrop, path, fov, train, test, distance, gains, workers)


def _write_capture(plan: _Plan, options: SynthOptions, folder: Path, quiet: bool) -> dict:
    """Write all files of the capture except `synth.json`, and return the entries of that."""
    surface, caster, train, test = plan.surface, plan.caster, plan.train, plan.test
    unit = depth_unit(surface, train + test) if options.depth_format == "png" else 1.0
    single = without_threads(caster)
    renderer = Renderer(surface, single, options, plan.backdrop, unit, folder, plan.gains)
    covered = render_views(renderer, train, test, plan.workers, quiet=quiet)
    told = _told(plan, options)
    cloud = _cloud(plan, options, renderer, told["train"], folder)
    write_colmap(folder / "sparse" / "0", told["train"], cloud, options.distortion, options.jpeg)
    write_points(folder / "points3D.ply", cloud)
    _write_reference(folder / "reference.ply", plan)
    shared = shared_keys(told["train"][0], unit, options, surface.unit)
    for split, cameras in told.items():
        frames = [frame_entry(split, i, camera, options) for i, camera in enumerate(cameras)]
        write_json(folder / f"transforms_{split}.json", {**shared, "frames": frames})
    if told["train"] is not train:
        true = {"train": train, "test": test}
        poses = {name: [camera.world_to_camera.tolist() for camera in true[name]] for name in true}
        write_json(folder / "truth_cameras.json", {"fl_x": train[0].fx, "fl_y": train[0].fy, "world_to_camera": poses})
    return {
        "shape": surface.name,
        "unit": surface.unit,
        **_described(options, plan.path, plan.backdrop, plan.gains),
        **renderer.effects.described(),
        "fov_degrees": plan.fov,
        "distance": plan.distance,
        "points": len(cloud.xyz),
        "mean_track_length": float(np.mean(cloud.track_length)) if len(cloud.xyz) else 0.0,
        "depth_unit_scale_factor": unit,
        "faces": len(surface.faces),
        "diagonal": surface.diagonal,
        "coverage": float(np.mean(covered)),
        "recast_rays": caster.recast + single.recast,
    }


def _told(plan: _Plan, options: SynthOptions) -> dict[str, list[Camera]]:
    """Return the training and held-out cameras as they are written: the true ones, or ones with errors."""
    true = {"train": plan.train, "test": plan.test}
    if not (options.pose_error or options.focal_error):
        return true
    depth, face, _ = plan.caster.render_depth(plan.train[0])
    distance = float(np.median(depth[face >= 0])) if (face >= 0).any() else plan.surface.diagonal
    return {
        split: reported(cameras, options.pose_error, options.focal_error, distance, (options.seed, POSE_SEED, number))
        for number, (split, cameras) in enumerate(true.items())
    }


def _cloud(plan: _Plan, options: SynthOptions, renderer: Renderer, told: list[Camera], folder: Path) -> ObservedPoints:
    """Return the points of the capture whose photographs are in `folder`."""
    photos = [folder / photo_name("train", number, options.jpeg) for number in range(len(told))]
    if options.points_from == "photographs":
        return photographed_points(told, photos, options.seed, plan.workers)
    traced = isinstance(plan.backdrop, TracedScene)
    cloud = sample_points(
        plan.surface,
        plan.caster,
        plan.train,
        renderer.light,
        count=options.points,
        noise=options.point_noise,
        seed=options.seed,
        distortion=options.distortion,
        by_pixels=traced or options.table > 0.0,
    )
    return photographed_colors(cloud, photos) if traced else cloud


# --- options ---


def _surface(shape, mesh, detail) -> TexturedMesh:
    if shape is not None and mesh is not None:
        raise LinprimError(f"--scene {shape!r} and --mesh {str(mesh)!r} are both given, wanted one of them")
    if isinstance(mesh, TexturedMesh):
        return mesh
    if mesh is not None:
        return load_textured(mesh, detail=detail)
    if (shape or "cad") not in SHAPES:
        raise LinprimError(f"--scene is {shape!r}, wanted one of {', '.join(SHAPES)}")
    return SHAPES[shape or "cad"](detail=detail)


def _backdrop(options: SynthOptions, inside: bool) -> Backdrop:
    """Return the background: an environment, a colour, or None for a transparent one."""
    if options.environment is not None:
        return synthetic_environment(options.environment)
    if options.background is None:
        return background_color("black" if inside else "transparent")
    return background_color(options.background)


def _described(options: SynthOptions, path: str, backdrop: Backdrop, gains: np.ndarray) -> dict:
    """Return the options as `synth.json` records them, with the chosen values in place of unset ones."""
    settings = {name: value for name, value in asdict(options).items() if name not in ("size", "fov", "threads")}
    width, height = options.width_height
    named = "transparent" if backdrop is None else "scene" if isinstance(backdrop, TracedScene) else "environment"
    color = list(backdrop) if isinstance(backdrop, tuple) else named
    arc = campath.ARC_DEG if options.arc is None else options.arc
    return {
        **settings,
        "path": path,
        "width": width,
        "height": height,
        "background": color,
        "arc": arc if path == "arc" else None,
        "gains": gains.tolist() if options.exposure_drift else [],
    }


def _gains(options: SynthOptions) -> np.ndarray:
    """Return (views, 3) gains of the training photographs, of geometric mean 1 per channel."""
    rng = np.random.default_rng([options.seed, 5])
    log = rng.uniform(-1.0, 1.0, (options.views, 1)) + 0.25 * rng.uniform(-1.0, 1.0, (options.views, 3))
    return np.exp(options.exposure_drift * (log - log.mean(0)))


# --- files ---


def _write_reference(path: Path, plan: _Plan) -> None:
    """Write the surface; of a path-traced scene, only the part that training views see."""
    from linprim_geo.geometry.mesh import Mesh
    from linprim_geo.geometry.mesh_files import save_mesh

    vertices, faces, colors = plan.surface.refined(REFINE * plan.surface.diagonal)
    if isinstance(plan.backdrop, TracedScene):
        faces = faces[seen_faces(plan.caster, vertices, faces, plan.train)]
        used, faces = np.unique(faces, return_inverse=True)
        vertices, colors, faces = vertices[used], colors[used], faces.reshape(-1, 3)
    save_mesh(path, Mesh(vertices, faces, colors=colors))
