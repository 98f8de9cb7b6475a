"""The environment map in a training step: its loss term, and which of its texels cameras see past the primitives."""

from __future__ import annotations

from collections.abc import Iterable

import torch

from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels import ops
from linprim_geo.points.colors_at_infinity import SAME_COLOR

# A texel counts as seen if its summed weight, transmittance times bilinear weight over the pixels of all views, exceeds
# this (in pixels).
LEAST_WEIGHT = 0.5


def contradiction(photo: torch.Tensor, passed: torch.Tensor, left: torch.Tensor) -> torch.Tensor:
    """Return the mean over pixels of the transmittance `left` (H, W) times the colour difference between the
    environment and the photograph (3, H, W) beyond SAME_COLOR.

    `passed` (3, H, W) is the transmittance times the environment. Where the two colours differ, a surface must hide the
    environment. Without this term, a translucent surface of another colour in front of the environment would explain
    the photograph as well.

    Gradient: to `left`.
    """
    weight = left.detach()
    difference = (weight * photo).sub_(passed).abs_().mean(0) / weight.clamp_min(1e-6)
    return (left * difference.sub_(SAME_COLOR / 255).clamp_min_(0)).mean()


def seen_through(size: int, views: Iterable[tuple[Camera, torch.Tensor]]) -> torch.Tensor:
    """Return (6, size, size, 1) bool: the texels of a cube map that cameras see past the primitives.

    `views` are pairs of a camera and its rendered (H, W) opacity. Only pixels with opacity below 0.5 count.
    """
    weight = torch.zeros(6, size, size, 3)
    for camera, opacity in views:
        passing = torch.where(opacity < 0.5, opacity, 1.0)
        weight += ops.environment_weights(torch.ones(3, *opacity.shape), passing, size, camera)
    return weight[..., :1] > LEAST_WEIGHT
