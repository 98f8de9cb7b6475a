"""Building blocks for scenes of the hard classes: poses, extents, interior points, and scenes with a ray that is aimed
at one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from linprim_geo.base import kinds
from linprim_geo.eval.hard_cases import many_scenes
from linprim_geo.eval.hard_cases.many_scenes import Scenes
from linprim_geo.kernels.reference.rasterize import rotation_matrix

WINDOW = 4  # pixels along a side of the image of a scene
NEAR = 0.01
KINDS = tuple(kinds.KINDS)
POLYHEDRA = tuple(kind.name for kind in kinds.KINDS.values() if kind.solid)


def log_uniform(rng: np.random.Generator, low: float, high: float, *shape: int) -> np.ndarray:
    """Return random numbers whose logarithm to base 10 is uniform between `low` and `high`."""
    return 10 ** rng.uniform(low, high, shape)


def _rounded(x) -> Tensor:
    """Return the nearest float32 numbers, as float64."""
    return torch.as_tensor(np.asarray(x, dtype=np.float64)).float().double()


def extent_count(primitive: str) -> int:
    return 4 if primitive == "tetrahedron" else 3


def random_poses(rng: np.random.Generator, count: int, shift: float = 1.0) -> np.ndarray:
    pose = np.tile(np.eye(4), (count, 1, 1))
    pose[:, :3, :3] = rotation_matrix(torch.from_numpy(rng.normal(size=(count, 4)))).numpy()
    pose[:, :3, 3] = shift * rng.normal(size=(count, 3))
    return pose


def points_inside(rng: np.random.Generator, primitive: str, extent: np.ndarray, reach: float = 0.8) -> np.ndarray:
    """Return a random point in each primitive (..., 3), in local axes relative to its centre; with `reach` 1 points go
    up to the surface."""
    if primitive == "tetrahedron":
        share = rng.dirichlet(np.ones(4), extent.shape[:-1])
        share = reach * share + (1 - reach) / extent / (1 / extent).sum(-1, keepdims=True)  # the centre's own weights
        return (share * extent) @ many_scenes.CORNERS.numpy()
    y = rng.normal(size=(*extent.shape[:-1], 3))
    y *= reach * rng.random((*extent.shape[:-1], 1)) ** (1 / 3) / np.abs(y).sum(-1, keepdims=True)
    return y * extent


def build(
    rng: np.random.Generator,
    primitive: str,
    ray_model: str,
    center: np.ndarray,
    extent: np.ndarray,
    *,
    rotation: np.ndarray | None = None,
    pose: np.ndarray | None = None,
    density: np.ndarray | None = None,
    tau: np.ndarray | None = None,
    focal: np.ndarray | None = None,
    footprint: np.ndarray | None = None,
    near: np.ndarray | float = NEAR,
    target: np.ndarray | None = None,
    one_color: bool = False,
) -> Scenes:
    """Build scenes from centres in camera space, with an image window around the ray to a point of the first primitive.

    Args:
        center: (B, M, 3), camera space; extent: (B, M, 3 or 4).
        rotation: (B, M, 4) primitive to world; random if None.
        pose: (B, 4, 4) world to camera; random if None.
        density: (B, M); if None, chosen such that the optical thickness of each primitive along the aimed ray is `tau`
            (B, M), which is 0.01 to 3 if None.
        focal: (B,) px; if None, chosen such that the largest extent covers `footprint` (B,) px, which is 1 to 300 if
            None.
        target: (B, 3) point to aim at, camera space; a random point inside the first primitive if None.
    """
    count, many = center.shape[:2]
    pose = random_poses(rng, count) if pose is None else pose
    turn, shift = pose[:, :3, :3], pose[:, :3, 3]
    world = np.einsum("bji,bmj->bmi", turn, center - shift[:, None])
    rotation = rng.normal(size=(count, many, 4)) if rotation is None else rotation
    near = np.broadcast_to(np.asarray(near, dtype=np.float64), (count,))
    sh = rng.uniform(-0.8, 0.8, (count, many, 1, 3))
    if one_color:
        sh[:] = sh[:, :1]
    scenes = Scenes(
        primitive=primitive,
        ray_model=ray_model,
        center=_rounded(world),
        rotation=_rounded(rotation),
        extent=_rounded(extent),
        density=torch.ones(count, many, dtype=torch.float64),
        sh=_rounded(sh),
        pose=torch.from_numpy(pose.copy()),
        focal=torch.ones(count, 2, dtype=torch.float64),
        middle=torch.zeros(count, 2, dtype=torch.float64),
        near=torch.from_numpy(near.copy()),
        width=WINDOW,
        height=WINDOW,
        aimed=torch.zeros(count, dtype=torch.long),
    )

    # From here on with the numbers rounded to float32, so that the aimed ray hits.
    at, axes = (x.numpy()[:, 0] for x in many_scenes.camera_space(scenes))
    if target is None:
        for _ in range(12):
            point = at + np.einsum("bij,bj->bi", axes, points_inside(rng, primitive, scenes.extent.numpy()[:, 0]))
            if target is None:
                target = point
            target = np.where((target[:, 2] > near)[:, None] | (ray_model == "affine"), target, point)
    z = np.where(np.abs(at[:, 2]) > 1e-12, at[:, 2], 1.0)
    if ray_model == "affine" or primitive == "gaussian":
        middle, away = at[:, :2] / z[:, None], target - at
        aim = middle + (away[:, :2] - middle * away[:, 2:]) / z[:, None]
    else:
        aim = target[:, :2] / np.where(target[:, 2] > 0, target[:, 2], 1.0)[:, None]
    if focal is None:
        footprint = log_uniform(rng, 0, 2.5, count) if footprint is None else footprint
        size = np.abs(scenes.extent.numpy()[:, 0]).max(-1)
        distance = np.abs(target[:, 2]) if ray_model == "exact" else np.abs(z)
        focal = np.clip(footprint * distance / np.maximum(size, 1e-30), 0.5, 1e5)
    focal = np.stack([focal, focal * rng.uniform(0.9, 1.1, count)], -1)
    pixel = rng.integers(WINDOW, size=(count, 2))
    scenes = replace(
        scenes,
        focal=torch.from_numpy(focal),
        middle=torch.from_numpy(pixel + 0.5 - focal * aim),
        aimed=torch.from_numpy(pixel[:, 1] * WINDOW + pixel[:, 0]),
    )
    if density is None and primitive == "gaussian":
        density = rng.uniform(0.05, 1.0, (count, many))
    elif density is None:
        tau = log_uniform(rng, -2, 0.5, count, many) if tau is None else tau
        chord = many_scenes.aimed_chord(scenes).numpy()
        fallback = np.maximum(scenes.extent.numpy().min(-1), 1e-18)
        density = np.clip(tau / np.where(chord > 0, chord, fallback), 0, 1e18)
    return replace(scenes, density=_rounded(density))


def placed_before(rng, extent: np.ndarray, low: float = 0.3, high: float = 1.5) -> np.ndarray:
    """Return centres (B, M, 3) in front of the camera, at a depth of 10^low to 10^high times the largest extent of the
    first primitive; the other primitives are near the first."""
    count, many = extent.shape[:2]
    size = extent[:, 0].max(-1)
    z = size * log_uniform(rng, low, high, count)
    direction = np.concatenate([rng.uniform(-0.5, 0.5, (count, 2)), np.ones((count, 1))], 1)
    return (z[:, None] * direction)[:, None] + 0.3 * size[:, None, None] * rng.normal(size=(count, many, 3)) * (
        np.arange(many) > 0
    )[:, None]


def random_extents(rng, primitive: str, count: int, many: int = 1, low: float = -0.7, high: float = 0.3) -> np.ndarray:
    return log_uniform(rng, low, high, count, many, extent_count(primitive))
