"""Exposure and white balance of every training photograph: a gain per channel, fitted together with the scene.

A photograph of gain g shows g times the scene's colours, cut at white. Scene and gains share a factor per channel,
which is fixed by keeping the geometric mean of the gains over the photographs at 1: that is the exposure which renders
have.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from linprim_geo.kernels.adam import adam_rows
from linprim_geo.kernels.ops import exponential

# Adam's step in the logarithm of a gain at the start of a run, and the part of it at the end.
RATE, RATE_END = 1e-2, 0.05
# Where a photograph has reached this, of 1, it is white whatever the scene is.
WHITE = 254.5 / 255


class Exposure:
    """The gains of V photographs and what fitting them needs; `log_gain` (V, 3) float32 has mean 0 per channel."""

    TABLES = ("log_gain", "first", "second", "steps")

    def __init__(self, views: int, log_gain: np.ndarray | None = None):
        """`log_gain` (V, 3) is where to begin; without it every gain is 1."""
        start = torch.zeros(views, 3) if log_gain is None else torch.from_numpy(np.ascontiguousarray(log_gain)).float()
        self.log_gain = start - start.mean(0)
        self.first, self.second = torch.zeros(views, 3), torch.zeros(views, 3)
        self.steps = torch.zeros(views, dtype=torch.int32)

    def row(self, index: int) -> Tensor:
        """(3,) log gains of a photograph, as a leaf to differentiate."""
        return self.log_gain[index].clone().requires_grad_()

    def update(self, index: int, gradient: Tensor, part: float) -> None:
        """An Adam step of one photograph's gains, `part` of the run after its start, and the gauge."""
        gradients = torch.zeros_like(self.log_gain)
        gradients[index] = gradient
        touched = torch.zeros(len(self.steps), dtype=torch.bool)
        touched[index] = True
        tables = ([self.log_gain], [gradients], [self.first], [self.second])
        adam_rows(*tables, [RATE * RATE_END**part], self.steps, touched)
        self.log_gain -= self.log_gain.mean(0)

    @property
    def gains(self) -> np.ndarray:
        """(V, 3) float32."""
        return exponential(self.log_gain).numpy()

    def state(self) -> dict:
        """What a resumed run needs."""
        return {name: getattr(self, name) for name in self.TABLES}

    def restore(self, state: dict) -> None:
        """Takes back what `state` returned."""
        if set(state) != set(self.TABLES) or any(state[k].shape != getattr(self, k).shape for k in self.TABLES):
            raise ValueError(f"exposure has {sorted(state)}, wanted those of {len(self.steps)} photographs")
        for name in self.TABLES:
            setattr(self, name, state[name])


def exposed(rgb: Tensor, log_gain: Tensor, target: Tensor, behind: Tensor | None = None) -> Tensor:
    """(3, H, W) a rendering as a photograph with these (3,) log gains shows it.

    `behind` (3, H, W) is the part of it that the background makes up and the camera did not take, such as a random
    colour behind masks; it has no gain. Where `target` is white the rendering is cut at white: brighter is right, too.
    Gradient: to `rgb`, `log_gain` and `behind`.
    """
    gain = exponential(log_gain)[:, None, None]
    shown = rgb * gain if behind is None else (rgb - behind) * gain + behind
    return torch.where(target >= WHITE, shown.clamp_max(1.0), shown)


def best_gain(render: np.ndarray, photo: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """(3,) factors of the channels of (H, W, 3) `render` that bring it nearest to `photo`: least squares over pixels,
    weighted (H, W)."""
    weight = np.ones(render.shape[:2]) if weight is None else weight
    both = np.einsum("hwc,hwc,hw->c", render, photo, weight)
    own = np.einsum("hwc,hwc,hw->c", render, render, weight)
    return np.where(own > 0, both / np.maximum(own, np.finfo(float).tiny), 1.0)


def with_best_gain(render: np.ndarray, photo: np.ndarray, alpha: np.ndarray | None = None) -> np.ndarray:
    """(H, W, 3) `render` times the gain that brings it nearest to `photo`; where (H, W) `alpha` in [0, 1] lets the
    background through, this has no gain, and only what is opaque is compared."""
    gain = best_gain(render, photo, None if alpha is None else (alpha > 0.99).astype(float))
    return render * gain if alpha is None else render * (1 + alpha[..., None] * (gain - 1))
