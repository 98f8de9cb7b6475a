"""Images of a synthetic capture: colours, depth, normals and coverage of a view, and their files."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from linprim_geo.base.progress import Progress
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.synthetic.camera_effects import CameraEffects
from linprim_geo.synthetic.environment import SyntheticEnvironment
from linprim_geo.synthetic.options import Color, SynthOptions
from linprim_geo.synthetic.photos import photo_name, save_photo, save_png, sensor_noise, to_bytes
from linprim_geo.synthetic.points import camera_rays
from linprim_geo.synthetic.realism.scenes import TracedScene
from linprim_geo.synthetic.textured import TexturedMesh

Backdrop = Color | SyntheticEnvironment | TracedScene | None
"""The background: a colour, an environment, None for a transparent one; or a path tracer, which renders both surface
and background."""

NOISE_SEED = 6
"""Separates the random numbers of the sensor noise from those of the gains (5) and of the path `arc` (7)."""

RAYS_AT_ONCE = 16_384
"""Sub-pixel rays per step. Temporaries (at most some 3 kB per ray) then stay in cache."""

AMBIENT = 0.42
LIGHTS = (((0.5, -0.35, 0.8), 0.48), ((-0.7, 0.6, 0.1), 0.22))
"""Light of `shaded`: ambient strength, and (direction towards the light, strength) of two lamps at infinity."""

SHININESS = 12
"""Phong's exponent of the highlights, low enough for spherical harmonics of low degree to represent them."""


def render_views(
    renderer: Renderer, train: list[Camera], test: list[Camera], workers: int, *, quiet: bool = True
) -> list[float]:
    """Render all views to their files; return the share of pixels of each that show the surface. Prints progress to
    stderr, unless `quiet`."""
    jobs = [("train", i, camera) for i, camera in enumerate(train)]
    jobs += [("test", i, camera) for i, camera in enumerate(test)]
    for split in {split for split, _, _ in jobs}:
        for kind in ("", "depth", "normal", renderer.masks):
            (renderer.folder / kind / split).mkdir(parents=True, exist_ok=True)
    if isinstance(renderer.backdrop, TracedScene):
        renderer.backdrop.prepare()
        workers = 1  # the path tracer itself uses all cores
    progress, shares = Progress("rendered views", len(jobs), quiet=quiet), list[float]()
    with ThreadPoolExecutor(workers) as pool:
        for share in pool.map(lambda job: renderer.write(*job), jobs):
            shares.append(share)
            progress.update(len(shares))
    progress.clear()
    return shares


class Renderer:
    """Renders views and writes their files. `write` is safe to call from several threads."""

    def __init__(
        self,
        surface: TexturedMesh,
        caster: RayCaster,
        options: SynthOptions,
        backdrop: Backdrop,
        unit: float,
        folder: Path,
        gains: np.ndarray,
    ):
        self.surface, self.caster, self.options, self.gains = surface, caster, options, gains
        self.effects = CameraEffects(options)
        self.backdrop, self.unit, self.folder = backdrop, unit, folder
        self.masks = "masks" if backdrop is None else "truth_masks"
        self.normals = caster.face_normals().astype(np.float32)
        self.origin = surface.albedo_origin

    def write(self, split: str, number: int, camera: Camera) -> float:
        """Render one view to its files and return the share of pixels that show the surface."""
        depth, face, normal = self.render_depth(camera)
        if isinstance(self.backdrop, TracedScene):
            color, alpha = self.backdrop.picture(camera, split, number), (face >= 0).astype(np.float32)
        else:
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
        """Return (H, W, 3 or 4) uint8 for the result of `render`, with the background, effects, gain and noise."""
        gain = self.gains[number].astype(np.float32) if split == "train" else np.ones(3, np.float32)
        seed = (self.options.seed, NOISE_SEED, int(split == "test"), number)
        if self.backdrop is None:
            straight = gain * self.effects.apply(color / np.maximum(alpha, 1e-6)[..., None], split, number)
            pixels = to_bytes(sensor_noise(straight, self.options.noise, seed))
            return np.concatenate([pixels, to_bytes(alpha)[..., None]], axis=2)
        if isinstance(self.backdrop, tuple):
            color = color + (1.0 - alpha)[..., None] * np.array(self.backdrop, dtype=np.float32)
        color = self.effects.apply(color, split, number)
        return to_bytes(sensor_noise(gain * color, self.options.noise, seed))

    def render(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Return premultiplied colour (H, W, 3) float32 and coverage (H, W) float32, means of supersample^2 rays.

        The colour is that of the surface. It includes an environment where rays miss the surface, but not a plain
        background.
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
        """Return the result of `RayCaster.render_depth`, with the lens distortion."""
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
        """Return the indices (N,) of the rays (R, 3) that hit, and the colours (N, 3) float32 there."""
        distance, face, bary = self.caster.cast_single(origin, rays)
        seen = np.flatnonzero(face >= 0)
        face, direction = face[seen], rays[seen]
        points = (origin - self.origin).astype(np.float32) + distance[seen, None] * direction
        color = self.surface.albedo(points, face, bary[seen])
        return seen, self.light(color, face, direction)

    def light(self, color: np.ndarray, face: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the colours (N, 3) as seen along `direction` (N, 3) with the chosen shading."""
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


def depth_unit(surface: TexturedMesh, cameras: list[Camera]) -> float:
    """Return the smallest of 1, 2, 5 times a power of ten with which every depth of the scene fits in 16 bits."""
    corners = np.array(np.meshgrid(*np.stack([surface.vertices.min(0), surface.vertices.max(0)]).T)).reshape(3, -1).T
    farthest = max(float(camera.project(corners)[1].max()) for camera in cameras)
    exact = farthest / 65535.0
    power = 10.0 ** np.floor(np.log10(exact))
    return float(f"{next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= exact):.6g}")


def without_threads(caster: RayCaster) -> RayCaster:
    """Return a copy of the caster that uses one thread, for calls from many threads, with a counter of its own."""
    single = object.__new__(RayCaster)
    single.__dict__.update(caster.__dict__)
    single.threads, single.recast = 1, 0
    return single
