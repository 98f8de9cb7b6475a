"""Exposure and white balance: one gain per colour channel of each training photograph, fitted together with the scene.

A photograph with gain g shows g times the scene's colours, clipped at white. A common factor of scene and gains is not
determined by the photographs; it is fixed by keeping the geometric mean of the gains at 1 per channel. Renders have
this mean exposure.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from linprim_geo.kernels.adam import adam_rows
from linprim_geo.kernels.ops import exponential

# Adam learning rate of the log gains at the start of a run, and the factor by which it has fallen at the end.
RATE, RATE_END = 1e-2, 0.05
# Values in [0, 1] from this on count as clipped: the photograph is white however bright the scene is.
WHITE = 254.5 / 255


class Exposure:
    """The gains of V photographs and their optimiser state. `log_gain` (V, 3) float32 has mean 0 per channel."""

    TABLES = ("log_gain", "first", "second", "steps")

    def __init__(self, views: int, log_gain: np.ndarray | None = None):
        """`log_gain` (V, 3) are the initial values; without it, every gain is 1."""
        start = torch.zeros(views, 3) if log_gain is None else torch.from_numpy(np.ascontiguousarray(log_gain)).float()
        self.log_gain = start - start.mean(0)
        self.first, self.second = torch.zeros(views, 3), torch.zeros(views, 3)
        self.steps = torch.zeros(views, dtype=torch.int32)

    def row(self, index: int) -> Tensor:
        """Return the (3,) log gains of a photograph as a new leaf tensor that requires gradients."""
        return self.log_gain[index].clone().requires_grad_()

    def update(self, index: int, gradient: Tensor, part: float) -> None:
        """Make one Adam step for the gains of one photograph, then subtract the mean log gain. `part` is the share of
        the run that has passed."""
        gradients = torch.zeros_like(self.log_gain)
        gradients[index] = gradient
        touched = torch.zeros(len(self.steps), dtype=torch.bool)
        touched[index] = True
        tables = ([self.log_gain], [gradients], [self.first], [self.second])
        adam_rows(*tables, [RATE * RATE_END**part], self.steps, touched)
        self.log_gain -= self.log_gain.mean(0)

    @property
    def gains(self) -> np.ndarray:
        """Return the (V, 3) float32 gains."""
        return exponential(self.log_gain).numpy()

    def state(self) -> dict:
        """Return the tables that a resumed run needs."""
        return {name: getattr(self, name) for name in self.TABLES}

    def restore(self, state: dict) -> None:
        """Restore what `state` returned."""
        if set(state) != set(self.TABLES) or any(state[k].shape != getattr(self, k).shape for k in self.TABLES):
            raise ValueError(f"exposure has {sorted(state)}, wanted those of {len(self.steps)} photographs")
        for name in self.TABLES:
            setattr(self, name, state[name])


def exposed(rgb: Tensor, log_gain: Tensor, target: Tensor, behind: Tensor | None = None) -> Tensor:
    """Return a (3, H, W) rendering as a photograph with (3,) log gains shows it.

    `behind` (3, H, W) is the part of the rendering that comes from a background that the camera did not capture, such
    as a random colour behind masks; no gain applies to it. Where `target` is white, the rendering is clipped at white,
    so brighter values cause no error.
    Gradient: to `rgb`, `log_gain` and `behind`.
    """
    gain = exponential(log_gain)[:, None, None]
    shown = rgb * gain if behind is None else (rgb - behind) * gain + behind
    return torch.where(target >= WHITE, shown.clamp_max(1.0), shown)


def best_gain(render: np.ndarray, photo: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """Return the (3,) gains per channel that bring (H, W, 3) `render` nearest to `photo`, by least squares over pixels
    with (H, W) weights."""
    weight = np.ones(render.shape[:2]) if weight is None else weight
    both = np.einsum("hwc,hwc,hw->c", render, photo, weight)
    own = np.einsum("hwc,hwc,hw->c", render, render, weight)
    return np.where(own > 0, both / np.maximum(own, np.finfo(float).tiny), 1.0)


def with_best_gain(render: np.ndarray, photo: np.ndarray, alpha: np.ndarray | None = None) -> np.ndarray:
    """Return (H, W, 3) `render` times the gain that brings it nearest to `photo`.

    With (H, W) `alpha` in [0, 1], the gain is fitted to opaque pixels only and does not apply to the background that
    shows through.
    """
    gain = best_gain(render, photo, None if alpha is None else (alpha > 0.99).astype(float))
    return render * gain if alpha is None else render * (1 + alpha[..., None] * (gain - 1))
