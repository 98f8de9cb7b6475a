"""Renders images of a mesh from a run's cameras, with its texture or vertex colours, like a viewer."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.types import View
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.runs.run import Run
from linprim_geo.synthetic.textured import FileAlbedo, TexturedMesh, load_textured

SAMPLES = 3
"""Rays along each side of a pixel. Outlines are accurate to 1/18 of a pixel."""

RAYS_AT_ONCE = 1 << 20


def render_mesh(run: Run, views: Iterable[View], mesh: str | os.PathLike) -> Iterator[tuple[View, dict]]:
    """Render a mesh in the data set's frame, as `Run.render_views` renders primitives: unlit, over the run's background
    or environment.

    Yields: (view, images) with float32 `rgb` (3, H, W) in [0, 1] and `opacity` (H, W), the share of each pixel that the
    mesh covers.

    Raises:
        LinprimError: the mesh cannot be read, or has no colours.
    """
    surface = load_textured(mesh)
    if not isinstance(surface.albedo, FileAlbedo):
        raise LinprimError(f"{mesh}: has neither a texture nor colours")
    caster = RayCaster(surface.vertices, surface.faces)
    for view in views:
        color, covered = _seen(surface, caster, view.camera)
        yield view, {"rgb": color + (1 - covered) * _behind(run, view.camera), "opacity": covered}


def _seen(surface: TexturedMesh, caster: RayCaster, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return colour (3, H, W) times coverage, and coverage (H, W), float32, as means over the rays of each pixel."""
    fine = camera.magnified(SAMPLES)
    color = np.zeros((camera.height, camera.width, 3), np.float32)
    covered = np.zeros((camera.height, camera.width), np.float32)
    origin = (camera.center - surface.albedo_origin).astype(np.float32)
    x = (np.arange(fine.width) + 0.5 - fine.cx) / fine.fx
    rows_at_once = max(1, RAYS_AT_ONCE // (SAMPLES * fine.width))
    for top in range(0, camera.height, rows_at_once):
        rows = slice(top, min(top + rows_at_once, camera.height))
        y = (np.arange(SAMPLES * rows.start, SAMPLES * rows.stop) + 0.5 - fine.cy) / fine.fy
        rays = np.stack([*np.meshgrid(x, y), np.ones((len(y), len(x)))], axis=-1).reshape(-1, 3) @ camera.rotation
        distance, face, bary = caster.cast_single(camera.center, rays)
        hit = np.flatnonzero(face >= 0)
        points = origin + distance[hit, None] * rays[hit].astype(np.float32)
        shown = np.zeros((len(rays), 4), np.float32)
        shown[hit, :3] = surface.albedo(points, face[hit], bary[hit])
        shown[hit, 3] = 1
        means = shown.reshape(-1, SAMPLES, camera.width, SAMPLES, 4).mean((1, 3))
        color[rows], covered[rows] = means[..., :3], means[..., 3]
    return np.moveaxis(color, -1, 0), covered


def _behind(run: Run, camera: Camera) -> np.ndarray:
    """Return (3, H, W) or (3, 1, 1) float32 the run's environment or background colour."""
    import torch

    from linprim_geo.kernels import ops

    environment = run.environment
    if environment is None:
        return np.asarray(run.background, np.float32)[:, None, None]
    nothing = torch.zeros(camera.height, camera.width, dtype=environment.dtype)
    return ops.environment_light(nothing, environment, camera.transformed(run.similarity)).float().numpy()
