"""Dropout of primitives: each training step omits a random share of them.

With few photographs, primitives overfit: each photograph is explained by primitives close to its own camera. Omitting
some in each step forces the others to be right by themselves. Neighbours are omitted together, because each could
replace the others. The densities of the rest are raised so that the expected optical depth stays the same.

Source: DropGaussian (Park et al. 2025), and DropAnSH-GS (2026) for neighbours.
"""

from __future__ import annotations

import numpy as np
import torch

from linprim_geo.geometry.primitives import Tensors

# Number of neighbours along the space-filling curve that are omitted or kept together.
TOGETHER = 10
# With --dropout auto, captures with at most FEW_PHOTOGRAPHS training photographs omit this SHARE of the primitives per
# step; others omit none.
FEW_PHOTOGRAPHS, SHARE = 10, 0.2
# Bits per coordinate of the Morton code that orders primitives.
BITS = 10


def with_dropout(active: Tensors, share: float, seed: int, step: int) -> Tensors:
    """Return the rasterizer's inputs with the density of a random `share` of the primitives set to 0.

    Primitives are dropped in runs of TOGETHER along a Morton curve. The other densities are divided by 1 - `share`. The
    choice depends on `seed` and `step` alone.

    Gradient: none to dropped primitives.
    """
    center, rotation, extent, density, colors = active
    rng = np.random.default_rng([seed, 5, step])
    count = len(center)
    run = (np.arange(count) + rng.integers(TOGETHER)) // TOGETHER
    kept = rng.random(count // TOGETHER + 2) >= share
    factor = np.empty(count, np.float32)
    factor[along_curve(center.detach().numpy())] = np.where(kept[run], 1 / (1 - share), 0)
    return center, rotation, extent, density * torch.from_numpy(factor).to(density.dtype), colors


def along_curve(points: np.ndarray) -> np.ndarray:
    """Return the (N,) row indices of (N, 3) points in Morton order, within the box that leaves out 1 % of the points at
    each side."""
    low, high = np.quantile(points, (0.01, 0.99), axis=0)
    cell = ((points - low) / np.maximum(high - low, 1e-12)).clip(0, 1) * (2**BITS - 1)
    x, y, z = _spread(cell.T.astype(np.int64))
    return np.argsort(x | y << 1 | z << 2, kind="stable")


def _spread(number: np.ndarray) -> np.ndarray:
    """Insert two zero bits between the bits of numbers of BITS bits."""
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        number = (number | number << shift) & mask
    return number


def chosen_share(asked: float | str, photographs: int) -> float:
    """Return the dropout share: the value of --dropout, or with "auto" a share chosen by the number of training
    photographs."""
    if isinstance(asked, str):
        return SHARE if photographs <= FEW_PHOTOGRAPHS else 0.0
    return asked
