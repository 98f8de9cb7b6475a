"""A mesh as a person judges it: shaded, from three of its photographs' cameras, before and after it was smoothed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from linprim_geo.base.files import atomic_write
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.surface.visibility import render_preview

# Pictures next to each other, and pixels along the longer side of each.
VIEWS, PIXELS = 3, 480


def shaded_file(target: Path) -> Path:
    """Where the picture of a mesh goes."""
    return target.with_name(f"{target.stem}_shaded.png")


def save_shaded(target: Path, meshes: Sequence[tuple[Mesh, RayCaster]], cameras: Sequence[Camera]) -> Path:
    """Writes `shaded_file(target)`: a row per mesh, each from the same cameras in the same light, and returns it."""
    from PIL import Image

    chosen = [_small(cameras[index]) for index in apart(cameras)]
    height = max(camera.height for camera in chosen)
    rows = []
    for mesh, caster in meshes:
        grey = np.full(mesh.vertices.shape, 205, np.uint8)
        pictures = [render_preview(mesh, camera, colors=grey, caster=caster) for camera in chosen]
        lower = [np.pad(each, ((0, height - len(each)), (0, 0), (0, 0)), constant_values=255) for each in pictures]
        rows.append(np.concatenate(lower, axis=1))
    path = shaded_file(target)
    with atomic_write(path) as temporary:
        Image.fromarray(np.concatenate(rows)).save(temporary)
    return path


def apart(cameras: Sequence[Camera]) -> list[int]:
    """At most VIEWS cameras: the one most like all of them by where it stands and looks, and then those that are least
    like the ones before."""
    centers = np.array([camera.center for camera in cameras])
    spread = float(np.sqrt(centers.var(axis=0).sum()))
    looks = np.array([camera.rotation[2] for camera in cameras])  # the world's direction of the optical axis
    places = np.concatenate([centers / spread if spread > 0 else 0 * centers, looks], axis=1)
    chosen = [int(np.argmin(np.linalg.norm(places - places.mean(axis=0), axis=1)))]
    while len(chosen) < min(VIEWS, len(cameras)):
        nearest = np.linalg.norm(places[:, None] - places[chosen], axis=2).min(axis=1)
        chosen.append(int(np.argmax(nearest)))
    return chosen


def _small(camera: Camera) -> Camera:
    """The camera with pictures of at most PIXELS along the longer side."""
    scale = min(1.0, PIXELS / max(camera.width, camera.height))
    width, height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    x, y = width / camera.width, height / camera.height
    return Camera(width, height, camera.fx * x, camera.fy * y, camera.cx * x, camera.cy * y, camera.world_to_camera)
