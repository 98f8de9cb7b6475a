"""Renders a mesh for visual inspection: shaded, from three of its photographs' cameras, before and after smoothing."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from linprim_geo.base.files import atomic_write
from linprim_geo.geometry.boxes import smaller
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.surface.mesh_views import MeshViews
from linprim_geo.surface.visibility import render_preview

# Number of pictures next to each other, and the most pixels along the longer side of each.
VIEWS, PIXELS = 3, 480
# Grey value (of 255) of the surface where it faces the light.
GREY = 205
# Cameras closer to each other than this share of their coordinates count as in one place, as they differ only by
# rounding.
ROUNDING = 1e-9


def shaded_file(target: Path) -> Path:
    """Return the path of the picture of a mesh."""
    return target.with_name(f"{target.stem}_shaded.png")


def save_shaded(target: Path, rows: Sequence[np.ndarray]) -> None:
    """Write rows by `shaded_row`, one below the other, to `shaded_file(target)`."""
    from PIL import Image

    with atomic_write(shaded_file(target)) as temporary:
        Image.fromarray(np.concatenate(rows)).save(temporary)


def shaded_row(mesh: Mesh, caster: MeshViews, cameras: Sequence[Camera]) -> np.ndarray:
    """Return (H, W, 3) uint8: the mesh from the cameras that `most_different` chooses, next to each other, each lit
    from its camera."""
    chosen = [cameras[index] for index in most_different(cameras)]
    chosen = [smaller(camera, -(-max(camera.width, camera.height) // PIXELS)) for camera in chosen]
    height = max(camera.height for camera in chosen)
    colors = np.full(mesh.vertices.shape, GREY, np.uint8)
    pictures = [render_preview(mesh, camera, colors=colors, caster=caster) for camera in chosen]
    padded = [np.pad(each, ((0, height - len(each)), (0, 0), (0, 0)), constant_values=255) for each in pictures]
    return np.concatenate(padded, axis=1)


def most_different(cameras: Sequence[Camera]) -> list[int]:
    """Return the indices of VIEWS cameras, or of all if there are fewer.

    The first is the closest to the mean position and viewing direction, each further one the farthest from those chosen
    before.
    """
    centers = np.array([camera.center for camera in cameras])
    spread = float(np.sqrt(centers.var(axis=0).sum()))
    looks = np.array([camera.rotation[2] for camera in cameras])  # the world's direction of the optical axis
    if spread <= ROUNDING * np.abs(centers).max(initial=0):  # all in one place
        centers, spread = 0 * centers, 1.0
    places = np.concatenate([centers / spread, looks], axis=1)
    chosen = [int(np.argmin(np.linalg.norm(places - places.mean(axis=0), axis=1)))]
    while len(chosen) < min(VIEWS, len(cameras)):
        nearest = np.linalg.norm(places[:, None] - places[chosen], axis=2).min(axis=1)
        chosen.append(int(np.argmax(nearest)))
    return chosen
