"""Synthetic captures: posed images, depth, normals, masks and SfM-like points of a mesh whose surface is
known."""

from __future__ import annotations

import os
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from linprim_geo.base.cores import usable_cores
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import write_json
from linprim_geo.base.options import with_changes
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.synthetic import camera_paths as campath
from linprim_geo.synthetic.built_in import SHAPES, TEXTURES
from linprim_geo.synthetic.cameras import place_cameras
from linprim_geo.synthetic.environment import SyntheticEnvironment, synthetic_environment
from linprim_geo.synthetic.files import frame_entry, prepare_folder, publish_folder, shared_keys
from linprim_geo.synthetic.options import Color, SynthOptions, background_color, check_together
from linprim_geo.synthetic.photos import photo_name, save_photo, save_png, sensor_noise, to_bytes
from linprim_geo.synthetic.points import camera_rays, sample_points, write_colmap, write_points
from linprim_geo.synthetic.tabletop import on_table
from linprim_geo.synthetic.textured import TexturedMesh, load_textured

Backdrop = Color | SyntheticEnvironment | None
"""What stands behind the surface; None is a transparent background."""

NOISE_SEED = 6
"""Tells the random numbers of the sensor noise from those of the gains (5) and of the path `arc` (7)."""

RAYS_AT_ONCE = 16_384
"""Sub-pixel rays per step: the temporaries of one step (some 3 kB per ray at most) stay in cache."""

AMBIENT = 0.42
LIGHTS = (((0.5, -0.35, 0.8), 0.48), ((-0.7, 0.6, 0.1), 0.22))
"""Light of `shaded`: ambient, and (direction towards the light, strength) of two lamps at infinity."""

SHININESS = 12
"""Phong's exponent of the highlights: wide enough for spherical harmonics of low degree to follow."""

REFINE = 0.01
"""Edges of reference.ply in units of the diagonal: its vertices carry the colours."""


def synthesize(
    out: str | os.PathLike,
    options: SynthOptions | None = None,
    *,
    shape: str | None = None,
    mesh: str | os.PathLike | TexturedMesh | None = None,
    overwrite: bool = False,
    **changes: Any,
) -> dict:
    """Renders a capture of a built-in scene or of a mesh into the folder `out`, with the truth next to it.

    Written: `train/000.png ...` and `test/`; `depth/`, `normal/` and `masks/` with the same two folders in
    each; `transforms_train.json` and `transforms_test.json` (nerfstudio's keys, OpenGL camera-to-world);
    `sparse/0`, a COLMAP model of the training views and the points with their observations (image names
    relative to `out`); `points3D.ply`; `reference.ply`, the surface with vertex colours; `synth.json`, all
    parameters. The frame and unit are the mesh's own.

    Images are the mean of supersample^2 rays per pixel, in the stored (sRGB) values. Depth is along the
    optical axis, exactly at the pixel centre, rounded to `depth_unit_scale_factor` (at most 1/30000 of the
    largest depth) as uint16, 0 for nothing; or float32 as `.npy`. Normals are geometric, in the world's axes,
    towards the camera, (n + 1) / 2 in 8 bits, black for nothing. Masks are the coverage in 8 bits, the
    images' alpha; with an opaque background or an environment the images hold it already, and the coverage is
    in `truth_masks/` so that nobody applies it a second time.

    Args:
        out: folder to make; it must not exist or be empty. Everything is written to a temporary folder beside
            it that is renamed at the end.
        options: how it is photographed.
        shape: `cad`, `smooth`, `room`, `wires` or `hall`. One of `shape` and `mesh`; neither is `cad`.
        mesh: a mesh file with texture or vertex colours, or a `TexturedMesh`.
        overwrite: replace `out` if it was made by `synth` before.
        changes: fields of `options` by name, such as `views=16`.

    Returns:
        What was made: folder, counts, size, seconds.

    Raises:
        LinprimError: an option has no meaning, the mesh cannot be read, `out` is not empty or cannot be
        written.
    """
    start = time.perf_counter()
    out = Path(out)
    options = with_changes(SynthOptions, options, changes)
    subject = _surface(shape, mesh, options.detail * TEXTURES[options.texture])
    path = options.path or ("arc" if options.table else subject.path)
    backdrop = _backdrop(options, inside=path == "inside-out")
    check_together(options, path, transparent=backdrop is None)
    surface = on_table(subject, options.table, options.seed) if options.table else subject
    workers = options.threads or usable_cores()
    caster = RayCaster(surface.vertices, surface.faces, threads=workers)
    field = options.fov or (75.0 if path == "inside-out" else 45.0)
    train, test, distance = place_cameras(subject, caster, options, path, field)
    gains = _gains(options)

    temporary = prepare_folder(out, overwrite)
    try:
        unit = _depth_unit(surface, train + test) if options.depth_format == "png" else 1.0
        single = _without_threads(caster)
        renderer = _Renderer(surface, single, options, backdrop, unit, temporary, gains)
        covered = _render_views(renderer, train, test, workers)
        cloud = sample_points(
            surface,
            caster,
            train,
            renderer.light,
            count=options.points,
            noise=options.point_noise,
            seed=options.seed,
            distortion=options.distortion,
            by_pixels=options.table > 0.0,
        )
        write_colmap(temporary / "sparse" / "0", train, cloud, options.distortion, options.jpeg)
        write_points(temporary / "points3D.ply", cloud)
        _write_reference(temporary / "reference.ply", surface)
        shared = shared_keys(train[0], unit, options, surface.unit)
        for split, cameras in (("train", train), ("test", test)):
            frames = [frame_entry(split, i, camera, options) for i, camera in enumerate(cameras)]
            write_json(temporary / f"transforms_{split}.json", {**shared, "frames": frames})
        report = {
            "output": str(out),
            "shape": surface.name,
            "unit": surface.unit,
            **_described(options, path, backdrop, gains),
            "fov_degrees": field,
            "distance": distance,
            "points": len(cloud.xyz),
            "mean_track_length": float(np.mean(cloud.track_length)) if len(cloud.xyz) else 0.0,
            "depth_unit_scale_factor": unit,
            "faces": len(surface.faces),
            "diagonal": surface.diagonal,
            "coverage": float(np.mean(covered)),
            "recast_rays": caster.recast + single.recast,
        }
        write_json(temporary / "synth.json", report)
        publish_folder(temporary, out)
    except BaseException as error:
        shutil.rmtree(temporary, ignore_errors=True)
        if isinstance(error, OSError):
            raise LinprimError(f"{out}: cannot be written ({error.strerror or error}); nothing was kept") from error
        raise
    return {**report, "seconds": round(time.perf_counter() - start, 3)}


# What was asked for


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
    """What stands behind the surface: an environment, a colour, or nothing (None, transparent)."""
    if options.environment is not None:
        return synthetic_environment(options.environment)
    if options.background is None:
        return background_color("black" if inside else "transparent")
    return background_color(options.background)


def _described(options: SynthOptions, path: str, backdrop: Backdrop, gains: np.ndarray) -> dict:
    """The options as `synth.json` records them, with what was chosen where nothing was said."""
    settings = {name: value for name, value in asdict(options).items() if name not in ("size", "fov", "threads")}
    width, height = options.width_height
    color = list(backdrop) if isinstance(backdrop, tuple) else ("transparent" if backdrop is None else "environment")
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
    """(views, 3) gains of the training photographs, of geometric mean 1 per channel."""
    rng = np.random.default_rng([options.seed, 5])
    log = rng.uniform(-1.0, 1.0, (options.views, 1)) + 0.25 * rng.uniform(-1.0, 1.0, (options.views, 3))
    return np.exp(options.exposure_drift * (log - log.mean(0)))


def _without_threads(caster: RayCaster) -> RayCaster:
    """The same caster without threads of its own, to be called from many, with its own counter."""
    single = object.__new__(RayCaster)
    single.__dict__.update(caster.__dict__)
    single.threads, single.recast = 1, 0
    return single


# Pictures


def _render_views(renderer: _Renderer, train: list[Camera], test: list[Camera], workers: int) -> list[float]:
    """Renders all views into their files; returns the share of pixels of each that show the surface."""
    jobs = [("train", i, camera) for i, camera in enumerate(train)]
    jobs += [("test", i, camera) for i, camera in enumerate(test)]
    for split in {split for split, _, _ in jobs}:
        for kind in ("", "depth", "normal", renderer.masks):
            (renderer.folder / kind / split).mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(lambda job: renderer.write(*job), jobs))


class _Renderer:
    """Renders views and writes their files; `write` may run in several threads at once."""

    def __init__(self, surface, caster, options, backdrop: Backdrop, unit, folder, gains):
        self.surface, self.caster, self.options, self.gains = surface, caster, options, gains
        self.backdrop, self.unit, self.folder = backdrop, unit, folder
        self.masks = "masks" if backdrop is None else "truth_masks"
        self.normals = caster.face_normals().astype(np.float32)
        self.origin = surface.albedo_origin

    def write(self, split: str, number: int, camera: Camera) -> float:
        """Renders one view into its files and returns the share of pixels that show the surface."""
        depth, face, normal = self.render_depth(camera)
        color, alpha = self.render(camera)
        name = f"{split}/{number:03d}"
        photo = self.folder / photo_name(split, number, self.options.jpeg)
        save_photo(photo, self.photograph(split, number, color, alpha), self.options.jpeg)
        save_png(self.folder / self.masks / f"{name}.png", to_bytes(alpha))
        hit = face >= 0
        shown_normal = np.where(hit[..., None], 0.5 * (normal + 1.0), 0.0)
        save_png(self.folder / "normal" / f"{name}.png", to_bytes(shown_normal))
        if self.options.depth_format == "png":
            steps = np.where(hit, np.rint(np.where(hit, depth, 0.0) / self.unit), 0.0).astype(np.uint16)
            save_png(self.folder / "depth" / f"{name}.png", steps)
        else:
            np.save(self.folder / "depth" / f"{name}.npy", np.where(hit, depth, 0.0).astype(np.float32))
        return float(hit.mean())

    def photograph(self, split: str, number: int, color: np.ndarray, alpha: np.ndarray) -> np.ndarray:
        """(H, W, 3 or 4) uint8 of what `render` gives: behind it the background, gain and noise of the camera."""
        gain = self.gains[number].astype(np.float32) if split == "train" else np.ones(3, np.float32)
        seed = (self.options.seed, NOISE_SEED, int(split == "test"), number)
        if self.backdrop is None:
            straight = gain * color / np.maximum(alpha, 1e-6)[..., None]
            pixels = to_bytes(sensor_noise(straight, self.options.noise, seed))
            return np.concatenate([pixels, to_bytes(alpha)[..., None]], axis=2)
        if isinstance(self.backdrop, tuple):
            color = color + (1.0 - alpha)[..., None] * np.array(self.backdrop, dtype=np.float32)
        return to_bytes(sensor_noise(gain * color, self.options.noise, seed))

    def render(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Premultiplied colour (H, W, 3) float32 and coverage (H, W) float32, the mean of supersample^2 rays.

        The colour is that of the surface; an environment is in it where rays miss the surface, a plain background
        is not.
        """
        height, width, n = camera.height, camera.width, self.options.supersample
        color = np.zeros((height * width, 3), dtype=np.float32)
        alpha = np.zeros(height * width, dtype=np.float32)
        rotation = camera.rotation.astype(np.float32)
        rows_at_once = max(1, RAYS_AT_ONCE // width)
        steps = (np.arange(n) + 0.5) / n
        columns = np.arange(width)[None, :] + steps[:, None]
        for top in range(0, height, rows_at_once):
            rows = np.arange(top, min(top + rows_at_once, height))
            part = slice(top * width, (rows[-1] + 1) * width)
            for step in steps:
                for column in columns:
                    rays = camera_rays(camera, column, rows + step, self.options.distortion).astype(np.float32)
                    rays = rays.reshape(-1, 3) @ rotation
                    seen, shades = self.shade(camera.center, rays)
                    color[part][seen] += shades
                    alpha[part][seen] += 1.0
                    if isinstance(self.backdrop, SyntheticEnvironment):
                        missed = np.delete(np.arange(len(rays)), seen)
                        color[part][missed] += self.backdrop(rays[missed])
        count = np.float32(1.0 / (n * n))
        return (color * count).reshape(height, width, 3), (alpha * count).reshape(height, width)

    def render_depth(self, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`RayCaster.render_depth` through the lens."""
        if not self.options.distortion:
            return self.caster.render_depth(camera)
        columns, rows = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
        rays = camera_rays(camera, columns, rows, self.options.distortion).reshape(-1, 3) @ camera.rotation
        depth, face, _ = self.caster.cast(camera.center, rays)
        normal = self.normals[face]
        normal[(normal * rays).sum(1) > 0] *= -1.0
        normal[face < 0] = 0.0
        shape = (camera.height, camera.width)
        return depth.reshape(shape), face.reshape(shape), normal.reshape(*shape, 3)

    def shade(self, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which rays (R, 3) hit, as indices (N,), and the colours (N, 3) float32 there."""
        distance, face, bary = self.caster.cast_single(origin, rays)
        seen = np.flatnonzero(face >= 0)
        face, direction = face[seen], rays[seen]
        points = (origin - self.origin).astype(np.float32) + distance[seen, None] * direction
        color = self.surface.albedo(points, face, bary[seen])
        return seen, self.light(color, face, direction)

    def light(self, color: np.ndarray, face: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """The colours (N, 3) as seen along `direction` (N, 3) under the lamps of the chosen shading."""
        shaded, specular = self.options.shading == "shaded", self.options.specular
        if not shaded and not specular:
            return color
        normal = self.normals[face]
        away = np.einsum("nc,nc->n", normal, direction) > 0
        normal[away] *= -1.0
        strength = np.full(len(face), AMBIENT if shaded else 1.0, dtype=np.float32)
        highlight = np.zeros(len(face), dtype=np.float32)
        if specular:
            towards_eye = -direction / np.linalg.norm(direction, axis=1, keepdims=True)
            mirrored = 2.0 * (normal * towards_eye).sum(1, keepdims=True) * normal - towards_eye
        for towards, power in LIGHTS:
            lamp = np.array(towards, dtype=np.float32)
            lamp /= np.linalg.norm(lamp)
            if shaded:
                strength += np.float32(power) * np.maximum(normal @ lamp, 0.0)
            if specular:
                highlight += np.float32(specular * power) * np.maximum(mirrored @ lamp, 0.0) ** SHININESS
        return np.minimum(color * strength[:, None] + highlight[:, None], 1.0).astype(np.float32)


def _depth_unit(surface: TexturedMesh, cameras: list[Camera]) -> float:
    """The smallest of 1, 2, 5 times a power of ten with which every depth of the scene fits 16 bits."""
    corners = np.array(np.meshgrid(*np.stack([surface.vertices.min(0), surface.vertices.max(0)]).T)).reshape(3, -1).T
    farthest = max(float(camera.project(corners)[1].max()) for camera in cameras)
    exact = farthest / 65535.0
    power = 10.0 ** np.floor(np.log10(exact))
    return float(f"{next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= exact):.6g}")


# Files


def _write_reference(path: Path, surface: TexturedMesh) -> None:
    from linprim_geo.geometry.mesh import Mesh
    from linprim_geo.geometry.mesh_files import save_mesh

    vertices, faces, colors = surface.refined(REFINE * surface.diagonal)
    save_mesh(path, Mesh(vertices, faces, colors=colors))
