"""A wall without texture, lit by a lamp: analytic photographs with noise, and their true depths."""

from __future__ import annotations

import numpy as np
from helpers.captures import look_at

from linprim_geo.stereo.depth_maps import DepthMap

# The wall y = 0, a lamp near its upper left corner, the noise of grey values, and camera centres on an arc before it.
WALL, LAMP, NOISE = np.array([0.0, 1.0, 0.0, 0.0]), np.array([-0.9, 0.7, 0.8]), 2.0
CENTERS = [(2 * np.sin(angle), 2 * np.cos(angle), 0.2) for angle in np.radians(np.linspace(-35, 35, 9))]


def camera_at(center):
    return look_at(center, target=(0.0, 0.0, 0.0), size=(240, 180), focal=200.0)


def wall_depth(camera, bulge: float = 0.0) -> np.ndarray:
    """Returns the (H, W) depth of the wall, which a parabola moves forward by `bulge` in the middle."""
    rays = camera.world_rays()
    depth = -camera.center[1] / rays[..., 1]
    for _ in range(20 if bulge else 0):
        x = camera.center[0] + depth * rays[..., 0]
        depth = (bulge * np.maximum(1 - x**2, 0) - camera.center[1]) / rays[..., 1]
    return depth


def light(points: np.ndarray) -> np.ndarray:
    """Returns the grey values of a white wall in the lamp's light, with a display's gamma of 2.2."""
    towards = LAMP - points
    square = (towards**2).sum(-1)
    return 255 * np.clip(0.55 * towards[..., 1] / square**1.5, 0, 1) ** (1 / 2.2)


def map_of(camera, grey: np.ndarray, seed: int, noise: float = NOISE) -> DepthMap:
    """Returns a view without depths; `grey` gets noise."""
    noisy = grey + np.random.default_rng(seed).normal(0, noise, grey.shape)
    nothing = np.full(grey.shape, np.nan, np.float32)
    none = np.zeros(grey.shape, np.uint8)
    return DepthMap(
        camera=camera,
        depth=nothing,
        normal=np.full((*grey.shape, 3), np.nan, np.float32),
        confidence=none.astype(np.float32),
        confirming=none,
        deviation=nothing,
        grey=np.clip(np.rint(noisy), 0, 255).astype(np.uint8),
        noise=noise**2 + 1 / 12,
    )


def photographs(value, bulge: float = 0.0, seed: int = 0, noise: float = NOISE):
    """Returns the maps of all cameras with the grey values `value`(points, view), and the true depths."""
    maps, depths = [], []
    for view, center in enumerate(CENTERS):
        camera = camera_at(center)
        depth = wall_depth(camera, bulge)
        points = camera.center + camera.world_rays() * depth[..., None]
        maps.append(map_of(camera, value(points, view), seed + view, noise))
        depths.append(depth)
    return maps, depths
