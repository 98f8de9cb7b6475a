"""Training steps that leave out a part of the primitives.

With few photographs primitives conspire: each photograph is explained by what stands before its camera alone. If a step
does without some of them, the others have to be right by themselves. Neighbours are left out together, as each of them
could stand for the others. Densities of the rest are raised so that the expected optical depth stays.

Source: DropGaussian (Park et al. 2025), and DropAnSH-GS (2026) for neighbours.
"""

from __future__ import annotations

import numpy as np
import torch

from linprim_geo.geometry.primitives import Tensors

# So many neighbours are left out or kept together.
TOGETHER = 10
# Captures with no more photographs are trained so, unless --dropout says otherwise, and this share is left out.
FEW_PHOTOGRAPHS, SHARE = 10, 0.2
# Bits of each coordinate along the curve that neighbours are found by.
BITS = 10


def with_dropout(active: Tensors, share: float, seed: int, step: int) -> Tensors:
    """What the rasterizer takes with a random `share` of the primitives without density, in runs of TOGETHER along a
    curve that fills space (Morton's), and that of the others divided by 1 - `share`. Which ones depends on `seed` and
    `step` alone.

    Gradient: none to what is left out.
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
    """(N,) rows of (N, 3) points in the order in which Morton's curve meets them, within the box that holds all but 1 %
    on each side."""
    low, high = np.quantile(points, (0.01, 0.99), axis=0)
    cell = ((points - low) / np.maximum(high - low, 1e-12)).clip(0, 1) * (2**BITS - 1)
    x, y, z = _spread(cell.T.astype(np.int64))
    return np.argsort(x | y << 1 | z << 2, kind="stable")


def _spread(number: np.ndarray) -> np.ndarray:
    """Numbers of BITS bits with two zeros between each two bits."""
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        number = (number | number << shift) & mask
    return number


def chosen_share(asked: float | str, photographs: int) -> float:
    """The share of --dropout, which auto chooses by the number of training photographs."""
    if isinstance(asked, str):
        return SHARE if photographs <= FEW_PHOTOGRAPHS else 0.0
    return asked
