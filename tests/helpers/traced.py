"""Measurements of surfaces and cameras for the tests of path-traced scenes."""

from __future__ import annotations

import numpy as np

from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.synthetic.camera_paths import fibonacci_directions
from linprim_geo.synthetic.realism.scenes import TracedScene


def nearest_surface(traced: TracedScene, caster: RayCaster) -> float:
    """Returns the smallest distance between a camera and a surface, in metres, along 500 directions per camera."""
    probe = fibonacci_directions(500)
    views = traced.train + traced.test
    return min(float(caster.cast(np.tile(view.center, (len(probe), 1)), probe)[0].min()) for view in views)


def unit_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Returns (F, 3) unit normals of faces, 0 for faces without area."""
    normal = np.cross(*(vertices[faces[:, i]] - vertices[faces[:, 0]] for i in (1, 2)))
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-15)


def pixel_rays(view: Camera) -> np.ndarray:
    """Returns (H, W, 3) world directions through the centres of the pixels, of depth 1."""
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    ray = np.stack([(x - view.cx) / view.fx, (y - view.cy) / view.fy, np.ones_like(x)], -1)
    return ray @ view.world_to_camera[:3, :3]
