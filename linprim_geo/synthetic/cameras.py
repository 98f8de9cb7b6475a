"""The cameras of a synthetic capture: poses of the chosen path, focal lengths, and the distance to an object."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.synthetic import camera_paths as campath
from linprim_geo.synthetic.options import SynthOptions
from linprim_geo.synthetic.textured import TexturedMesh


def place_cameras(
    surface: TexturedMesh, caster: RayCaster, options: SynthOptions, path: str, fov: float
) -> tuple[list[Camera], list[Camera], float | None]:
    """Return training cameras, held-out cameras, and their distance from the centre of the surface (None inside it).

    Args:
        surface: the object or room to photograph, without a table.
        caster: of `surface`; used only for cameras inside.
        options: if no distance is given, it is the smallest at which the surface is inside all images (for an arc:
            all images of a hemisphere).
        path, fov: those of the options, or the surface's defaults.

    Raises:
        LinprimError: the distance or the offset is invalid, or there is no room for cameras inside.
    """
    width, height = options.width_height
    focal = 0.5 * width / np.tan(0.5 * np.deg2rad(fov))
    half = (0.5 * np.deg2rad(fov), float(np.arctan(0.5 * height / focal)))
    dx, dy = (float(value) for value in options.principal_point_offset)
    if not -max(width, height) <= min(dx, dy) <= max(dx, dy) < np.inf:
        raise LinprimError(f"--principal-point-offset is {dx:g},{dy:g}, wanted at least -{max(width, height)}")
    base = Camera(width, height, focal, focal, 0.5 * width + dx, 0.5 * height + dy, np.eye(4))
    if path == "inside-out":
        poses, held_out = campath.inside_out(caster, options.views, options.test_views, half, options.seed)
        distance = None
    else:
        poses, held_out, distance = _poses_around(surface, options, path, base)
    train, test = ([replace(base, world_to_camera=pose) for pose in some] for some in (poses, held_out))
    return _zoomed(train, options.zoom), _zoomed(test, options.zoom), distance


def _poses_around(surface: TexturedMesh, options: SynthOptions, path: str, base: Camera):
    """Return training and held-out (4, 4) world-to-camera poses around the surface, and their distance from its
    centre."""
    vertices = surface.used_vertices
    center = 0.5 * (vertices.min(0) + vertices.max(0))
    radius = float(np.linalg.norm(vertices - center, axis=1).max())
    on_arc = path == "arc"
    distance = options.distance
    if distance is None:
        fitted = "hemisphere" if on_arc else path
        distance = campath.fitting_distance(fitted, vertices, center, options.views, base)
    nearest = distance * (1.0 - campath.ARC_DISTANCE) if on_arc else distance
    if nearest <= radius:
        raise LinprimError(
            f"--distance is {distance:g}, but the object reaches {radius:g} from its middle"
            f"{f' and the nearest view is at {nearest:g}' if on_arc else ''}; more is wanted"
        )
    if on_arc:
        degrees = campath.ARC_DEG if options.arc is None else options.arc
        poses, held_out = campath.arc(options.views, options.test_views, center, distance, degrees, options.seed)
        return poses, held_out, distance
    poses = campath.around(path, options.views, center, distance)
    return poses, campath.around(path, options.test_views, center, distance, held_out=True), distance


def _zoomed(cameras: list[Camera], zoom: float) -> list[Camera]:
    """Return the cameras, every third one with `zoom` times the focal length."""
    return [replace(c, fx=c.fx * zoom, fy=c.fy * zoom) if i % 3 == 1 else c for i, c in enumerate(cameras)]
