"""Find primitives that only one view sees: seen by one camera alone, they may lie at any depth."""

from __future__ import annotations

import torch

from linprim_geo.geometry.camera import Camera

# A primitive counts as seen by one view alone if the spread of its viewing directions is a hundredth of the scene's
# median: a tenth of the angle.
SINGLE_VIEW = 0.01
# Summed blending weight over all views up to which a primitive counts as hidden.
HIDDEN = 0.5


class Support:
    """How the blending weight of (N, 3) centres is spread over viewing directions.

    In each view, w is the largest blending weight (T alpha) of a primitive, and u the unit vector from the camera to
    it. The spread is 1 - |sum of w u| / sum of w: 0 for one view, a^2 / 8 for two equal views separated by a small
    angle a, 1 for views all around.
    """

    def __init__(self, center: torch.Tensor):
        self.center = center.detach().double()
        self.weight = torch.zeros(len(center), dtype=torch.float64)
        self.along = torch.zeros(len(center), 3, dtype=torch.float64)

    def add(self, camera: Camera, weight: torch.Tensor) -> None:
        """Add a view in which the primitives have the weights (N,)."""
        away = self.center - torch.from_numpy(camera.center)
        away = away / torch.linalg.vector_norm(away, dim=1, keepdim=True).clamp_min(1e-12)
        self.weight += weight
        self.along += weight[:, None] * away

    def spread(self) -> torch.Tensor:
        """Return the (N,) spread of the directions; NaN for primitives that no view sees."""
        return (1 - torch.linalg.vector_norm(self.along, dim=1) / self.weight).clamp_min(0)

    def alone(self) -> torch.Tensor:
        """Return (N,) bool: whether a primitive is seen, and by one view alone."""
        spread, seen = self.spread(), self.weight > HIDDEN
        if not bool(seen.any()):
            return seen
        return seen & (spread < SINGLE_VIEW * spread[seen].median())
