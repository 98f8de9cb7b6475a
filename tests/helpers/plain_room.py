"""A room whose walls have one grey value each, in photographs with noise."""

from __future__ import annotations

import numpy as np
from helpers.captures import look_at

from linprim_geo.geometry.camera import Camera
from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.planes.plain_regions import in_camera
from linprim_geo.stereo.planes.point_planes import SurfacePoints

# Planes (n, d), n . x = d, of a room of 3 by 2 m and 2 m high with its floor at z = 0. Normals point inward; the first
# plane is the floor, the last the ceiling.
PLANES = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [-1, 0, 0, -3], [0, -1, 0, -2], [0, 0, -1, -2]])
GREYS = (90.0, 120, 150, 140, 170, 240)
NOISE, SIZE = 4.0, (400, 300)
MIDDLE = np.array([1.5, 1.0, 0.4])


def cameras(count: int = 24) -> list[Camera]:
    """Returns cameras on an ellipse in the room, looking across its middle at the other side."""
    turns = np.linspace(0, 2 * np.pi, count, endpoint=False)
    eyes = MIDDLE + np.stack([1.1 * np.cos(turns), 0.7 * np.sin(turns), 0.7 + 0.1 * np.sin(5 * turns)], axis=1)
    return [look_at(eye, MIDDLE - 0.3 * (eye - MIDDLE) * [1, 1, 0], size=SIZE, focal=220.0) for eye in eyes]


def at_corner(count: int = 12, spread: float = 1.0, roll: bool = False) -> list[Camera]:
    """Returns cameras on an arc in the room, looking at its corner at the origin; `roll` turns them on their side."""
    turns = np.pi / 4 + spread * np.linspace(-0.6, 0.6, count)
    eyes = np.stack([1.9 * np.cos(turns), 1.9 * np.sin(turns), 0.9 + 0.2 * spread * np.sin(5 * turns)], axis=1)
    up = (1.0, -1.0, 0.0) if roll else (0.0, 0.0, 1.0)
    return [look_at(eye, (0.3, 0.3, 0.4), size=SIZE, focal=300.0, up=up) for eye in eyes]


def no_background(of: list[Camera]) -> list[np.ndarray]:
    """Returns (H, W) masks without background."""
    return [np.zeros((camera.height, camera.width), bool) for camera in of]


def seen(camera: Camera, planes: np.ndarray = PLANES) -> tuple[np.ndarray, np.ndarray]:
    """Returns the (H, W) depth of the room inside the planes, and the row of the plane that each pixel shows."""
    inverse = camera.ray_grid() @ in_camera(camera, planes).T
    return 1 / inverse.max(-1), inverse.argmax(-1)


def photographs(of: list[Camera], greys=GREYS, planes: np.ndarray = PLANES, seed: int = 0) -> list[DepthMap]:
    """Returns photographs with noise of the room, without depths."""
    return noisy_maps(of, [np.array(greys)[seen(camera, planes)[1]] for camera in of], seed)


def noisy_maps(of: list[Camera], images: list[np.ndarray], seed: int) -> list[DepthMap]:
    """Returns maps without depths, whose photographs are images (H, W) of grey values with noise."""
    maps = []
    for number, (camera, image) in enumerate(zip(of, images, strict=True)):
        noise = np.random.default_rng([seed, number]).normal(0, NOISE, image.shape)
        grey = np.clip(image + noise, 0, 255).astype(np.uint8)
        unknown = np.full(grey.shape, np.nan, np.float32)
        normal = np.zeros((*grey.shape, 3), np.float32)
        maps.append(DepthMap(camera, unknown, normal, unknown, grey, unknown, grey, NOISE**2))
    return maps


def floors(of: list[Camera], planes: np.ndarray = PLANES) -> list[np.ndarray]:
    """Returns the (H, W) depth of the floor in every view, NaN elsewhere."""
    return [np.where(which == 0, depth, np.nan) for depth, which in (seen(camera, planes) for camera in of)]


def points_of(of: list[Camera], known: list[np.ndarray]) -> SurfacePoints:
    """Returns surface points of the pixels with `known` depth, with upward normals."""
    parts, up = [], np.broadcast_to([0.0, 0, 1], (SIZE[1], SIZE[0], 3))
    for view, (camera, depth) in enumerate(zip(of, known, strict=True)):
        parts.append(SurfacePoints.of_view(view, camera, depth, up, 3000, np.random.default_rng(view)))
    return SurfacePoints.together(parts)
