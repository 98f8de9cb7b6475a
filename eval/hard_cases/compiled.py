"""Renders batches of tiny scenes and their gradients with each variant of the compiled kernels, and checks that the
results are finite."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from linprim_geo.eval.hard_cases.many_scenes import PARAMETERS, Scenes
from linprim_geo.kernels import ops

SCALARS = {"float32": torch.float32, "float64": torch.float64}
GEOMETRY_EVERY = 4  # the gradients of all geometric images are checked for NaN in one of this many scenes


@dataclass(frozen=True)
class Variant:
    """One variant of the kernels."""

    primitive: str
    ray_model: str
    order: str
    scalar: str

    @property
    def name(self) -> str:
        """The name, as ray model-order-scalar."""
        return f"{self.ray_model}-{self.order}-{self.scalar}"

    @property
    def eps(self) -> float:
        """Machine epsilon: distance from 1 to the next number."""
        return torch.finfo(SCALARS[self.scalar]).eps


def variants(scalars: Sequence[str] = tuple(SCALARS)) -> list[Variant]:
    """Return all variants for which the core has kernels. Both ray models of a Gaussian are the same and count once."""
    return [
        Variant(*variant)
        for variant in itertools.product(ops.KINDS, ops.RAY_MODELS, ops.ORDERS, scalars)
        if ops.has_kernels(*variant[:3]) and variant[:2] != ("gaussian", "exact")
    ]


def _finite(tensors: Sequence[Tensor]) -> bool:
    return bool(np.isfinite(np.concatenate([t.numpy().ravel() for t in tensors])).all())


def run_core(
    scenes: Scenes, variant: Variant, weights: Tensor, gradients: int
) -> tuple[Tensor, Tensor, list[Tensor], Tensor]:
    """Render every scene by itself and differentiate the first `gradients` scenes.

    Returns:
        rgb (B, 3, R), opacity (B, R), gradients to PARAMETERS (`gradients` rows each), all float64, and (B,) bool:
        whether all values of a scene are finite.
    """
    dtype = SCALARS[variant.scalar]
    tensors = [getattr(scenes, name).to(dtype) for name in PARAMETERS]
    background = torch.zeros(3, dtype=dtype)
    cotangent = weights.to(dtype).reshape(len(scenes), 4, scenes.height, scenes.width)
    focal, middle, near = scenes.focal.tolist(), scenes.middle.tolist(), scenes.near.tolist()
    kinds = [
        ops.KINDS.index(variant.primitive),
        ops.RAY_MODELS.index(variant.ray_model),
        ops.ORDERS.index(variant.order),
    ]
    rgb, opacity, grads, finite = [], [], [], []
    with torch.no_grad():
        for i in range(len(scenes)):
            inputs, geometry = [*(t[i] for t in tensors), background], int(i % 2 == 0)
            numbers, choices = (
                [*focal[i], *middle[i], near[i], 0.0, 0.5, 0.0],
                [scenes.width, scenes.height, *kinds, geometry],
            )
            out = torch.ops.linprim_geo.rasterize(*inputs, None, scenes.pose[i], numbers, choices)
            *planes, color, _, _ = out
            good = _finite(planes)
            rgb.append(planes[0].flatten(1).clone()), opacity.append(planes[1].flatten().clone())
            if i < gradients:
                given = [cotangent[i, :3], cotangent[i, 3], *[None] * 6]
                adjoint = torch.ops.linprim_geo.rasterize_grad
                got = adjoint(*inputs, scenes.pose[i], numbers, choices, color, planes, given)
                good &= _finite(got)
                grads.append([g.double() for g in got[:5]])
                if i % GEOMETRY_EVERY == 0:
                    given = [torch.linspace(-1, 1, p.numel(), dtype=dtype).view_as(p) for p in planes[:8]]
                    got = adjoint(*inputs, scenes.pose[i], numbers, choices, color, planes, given)
                    good &= _finite(got)
            finite.append(good)
    columns = [torch.stack(c) for c in zip(*grads, strict=True)] if grads else []
    return torch.stack(rgb).double(), torch.stack(opacity).double(), columns, torch.tensor(finite)
