"""The environment in a training step: its loss term, and which of its texels cameras see."""

from __future__ import annotations

from collections.abc import Iterable

import torch

from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels import ops
from linprim_geo.points.far_colors import SAME_COLOR

# Texels that less than this part of a pixel sees past the primitives are not seen.
LEAST_WEIGHT = 0.5


def contradiction(photo: torch.Tensor, passed: torch.Tensor, left: torch.Tensor) -> torch.Tensor:
    """Mean over the pixels of the transmittance `left` (H, W) times how much the environment differs from the
    photograph (3, H, W), beyond SAME_COLOR; `passed` (3, H, W) is the transmittance times the environment.

    Where the two differ there is a surface, and no light of the environment: without this term a translucent surface of
    another colour explains the photograph as well.

    Gradient: to `left`.
    """
    weight = left.detach()
    difference = (weight * photo).sub_(passed).abs_().mean(0) / weight.clamp_min(1e-6)
    return (left * difference.sub_(SAME_COLOR / 255).clamp_min_(0)).mean()


def seen_through(size: int, views: Iterable[tuple[Camera, torch.Tensor]]) -> torch.Tensor:
    """(6, size, size, 1) bool, the texels that cameras see past primitives of (H, W) opacity, where these let most of
    the light through."""
    weight = torch.zeros(6, size, size, 3)
    for camera, opacity in views:
        passing = torch.where(opacity < 0.5, opacity, 1.0)
        weight += ops.environment_weights(torch.ones(3, *opacity.shape), passing, size, camera)
    return weight[..., :1] > LEAST_WEIGHT
