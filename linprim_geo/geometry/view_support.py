"""Which primitives several views see, from different directions: what one camera alone sees may lie at any depth."""

from __future__ import annotations

import torch

from linprim_geo.geometry.camera import Camera

# A primitive is seen by one view alone if its directions lie a hundredth as far apart as is usual in the scene: a tenth
# of the angle.
SINGLE_VIEW = 0.01
# What all views together see less of than this is hidden: nothing is known of it.
HIDDEN = 0.5


class Support:
    """How the weight of (N, 3) centres is spread over the directions that they are seen from.

    With the largest weight w, T alpha, that a primitive has in each view, and the unit vector u from the camera to it,
    the spread is 1 - |sum of w u| / sum of w: 0 for one view, a^2 / 8 for two that see it alike under a small angle a,
    1 for all around.
    """

    def __init__(self, center: torch.Tensor):
        self.center = center.detach().double()
        self.weight = torch.zeros(len(center), dtype=torch.float64)
        self.along = torch.zeros(len(center), 3, dtype=torch.float64)

    def add(self, camera: Camera, weight: torch.Tensor) -> None:
        """Adds a view in which they have the weights (N,)."""
        away = self.center - torch.from_numpy(camera.center)
        away = away / torch.linalg.vector_norm(away, dim=1, keepdim=True).clamp_min(1e-12)
        self.weight += weight
        self.along += weight[:, None] * away

    def spread(self) -> torch.Tensor:
        """(N,) spread of the directions; NaN where no view sees anything."""
        return (1 - torch.linalg.vector_norm(self.along, dim=1) / self.weight).clamp_min(0)

    def alone(self) -> torch.Tensor:
        """(N,) bool, whether a primitive is seen, and by one view alone."""
        spread, seen = self.spread(), self.weight > HIDDEN
        if not bool(seen.any()):
            return seen
        return seen & (spread < SINGLE_VIEW * spread[seen].median())
