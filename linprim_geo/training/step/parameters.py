"""The raw trainable parameters: their initial values, their activation to rasterizer inputs, and the 3D filter."""

from __future__ import annotations

import math

import numpy as np
import torch

from linprim_geo.base.kinds import KINDS
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.primitives import SH_Y0, Tensors
from linprim_geo.kernels import ops

# The 3D filter has a length of sqrt(FILTER_VARIANCE) pixels. It counts views in which the primitive is deeper than
# FILTER_NEAR and at most FILTER_MARGIN of the image's size outside of it (LinPrim's box_factor and Mip-Splatting's
# limits). It is recomputed every FILTER_EVERY steps.
FILTER_VARIANCE, FILTER_NEAR, FILTER_MARGIN, FILTER_EVERY = 0.2, 0.2, 0.15, 1000


def initial_parameters(
    xyz: np.ndarray,
    rgb: np.ndarray,
    degree: int,
    seed: int,
    bounds: tuple[float, float],
    kind: str = "octahedron",
) -> dict[str, torch.Tensor]:
    """Return raw parameters with one primitive per point: opacity 0.5, random rotation, equal extents from the mean
    distance to the 3 nearest points (`Kind.start_extent`).

    `xyz` (P, 3) in the training frame, `rgb` (P, 3) uint8, `bounds` the smallest and largest extent.
    """
    from scipy.spatial import cKDTree

    count, what = len(xyz), KINDS[kind]
    rng = np.random.default_rng([seed, 2])
    neighbours = min(4, count)
    distance = cKDTree(xyz).query(xyz, k=neighbours)[0].reshape(count, -1)[:, 1:]
    size = np.full(count, bounds[1])
    if distance.shape[1]:
        size = what.start_extent(distance.mean(1))
    rotation = rng.normal(size=(count, 4))
    values = {
        "center": xyz,
        "rotation": rotation / np.linalg.norm(rotation, axis=1, keepdims=True),
        "log_extent": np.repeat(np.log(np.clip(size, *bounds))[:, None], what.extents, 1),
        "raw_opacity": np.zeros(count),
        "sh_dc": ((rgb / 255.0 - 0.5) / SH_Y0)[:, None, :],
        "sh_rest": np.zeros((count, (degree + 1) ** 2 - 1, 3)),
    }
    return {name: torch.from_numpy(np.ascontiguousarray(value, dtype=np.float32)) for name, value in values.items()}


def activate(
    parameters: dict[str, torch.Tensor],
    degree: int,
    kind: str = "octahedron",
    filter_3d: torch.Tensor | None = None,
) -> Tensors:
    """Convert raw parameters to the rasterizer's inputs: center, rotation, extent, density, sh.

    extent = exp(log_extent), enlarged by `filter_3d` (N,) with `Kind.widened`; `filter_3d` takes no gradient. The
    density comes from `Kind.density`.
    """
    what, extent = KINDS[kind], ops.exponential(parameters["log_extent"])
    if filter_3d is not None:
        extent = what.widened(extent, filter_3d)
    density = what.density(parameters["raw_opacity"], extent)
    count = (degree + 1) ** 2 - 1
    sh = parameters["sh_dc"] if count == 0 else torch.cat([parameters["sh_dc"], parameters["sh_rest"][:, :count]], 1)
    return parameters["center"], parameters["rotation"], extent, density, sh


def filter_lengths(center: torch.Tensor, cameras: list[Camera]) -> torch.Tensor:
    """Return (N,) float32 lengths f = sqrt(0.2) z / F of the 3D filter, a fraction of a pixel's size at the nearest
    camera that sees each of the (N, 3) centres.

    z is the smallest depth over the cameras that see the centre, F the largest focal length of all cameras. For a
    centre that no camera sees, z is the distance to the nearest camera. Source: Mip-Splatting (Yu et al. 2024),
    LinPrim's box_factor.
    """
    xyz = center.detach().numpy()
    least = np.full(len(xyz), np.inf, np.float32)
    for camera in cameras:
        x, y, z = (xyz @ camera.rotation.astype(np.float32).T + camera.world_to_camera[:3, 3].astype(np.float32)).T
        seen = z > FILTER_NEAR
        for along, focal, middle, size in (
            (x, camera.fx, camera.cx, camera.width),
            (y, camera.fy, camera.cy, camera.height),
        ):
            # -margin size < focal along / z + middle < (1 + margin) size
            reach = (0.5 + FILTER_MARGIN) * size
            seen &= np.abs(focal * along + (middle - size / 2) * z) < reach * z
        np.minimum(least, z, out=least, where=seen)
    unseen = ~np.isfinite(least)
    centers = np.stack([camera.center for camera in cameras]).astype(np.float32)
    for position in centers if unseen.any() else ():
        least[unseen] = np.minimum(least[unseen], np.linalg.norm(xyz[unseen] - position, axis=1))
    focal = max(max(camera.fx, camera.fy) for camera in cameras)
    return torch.from_numpy((math.sqrt(FILTER_VARIANCE) / focal * least).astype(np.float32))
