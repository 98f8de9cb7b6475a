"""How the number of primitives grows: where the image pulls hardest on a primitive, it is cut in two.

Parents are drawn in proportion to the screen-space gradient gathered since the last event. Primitives that have become
transparent or have shrunk to nothing are not deleted but become the second half of another parent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

# A primitive whose opacity along its shortest diagonal is below this is moved to where it is needed.
DEAD_OPACITY = 0.005
# Two halves of a split octahedron: centres at +-0.4 of the half-axis that is cut, which becomes 0.6 of itself, the others 0.8.
SPLIT_OFFSET, SPLIT_ALONG, SPLIT_ACROSS = 0.4, 0.6, 0.8


@dataclass(frozen=True)
class Growth:
    """When and how fast the population grows; steps are training iterations."""

    first: int
    last: int
    every: int
    rate: float  # of the present count, per event
    cap: int

    @staticmethod
    def plan(iterations: int, start: int, cap: int) -> Growth:
        """Events every 100 steps (60 in all of a shorter run) from 3 % to 60 % of the run.

        The rate brings `start` to `cap` a little before the last event.
        """
        every = max(10, min(100, iterations // 60))
        first, last = max(every, round(0.03 * iterations)), round(0.6 * iterations)
        events = max(1, (last - first) // every)
        rate = max(0.02, (max(cap, start) / max(1, start)) ** (1 / (0.9 * events)) - 1)
        return Growth(first, last, every, min(rate, 0.25), cap)

    def is_due(self, step: int) -> bool:
        """Whether the population changes after this step."""
        return self.first <= step <= self.last and step % self.every == 0


def grow(
    parameters: dict[str, torch.Tensor],
    pull: torch.Tensor,
    growth: Growth,
    smallest_log_extent: float,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Draws the parents of one event and computes their halves.

    Args:
        parameters: raw trainable tensors, `center` (N, 3), `rotation` (N, 4), `log_extent` (N, 3), `raw_opacity` (N,), ...
        pull: (N,) screen-space gradient gathered since the last event, >= 0.
        smallest_log_extent: a primitive with a half-axis at this floor counts as dead.

    Returns: rows (P,) of the parents, overwritten by their first halves; rows (P,) that receive the second halves, from N on where
        they are new; and the halves' `center` and `log_extent` as {"center": (2, P, 3), "log_extent": (2, P, 3)}.
        All other parameters of a half are its parent's.
    """
    log_extent = parameters["log_extent"].detach().numpy().astype(np.float64)
    opacity = 1 - np.exp(-np.logaddexp(0.0, parameters["raw_opacity"].detach().numpy().astype(np.float64)))
    count = len(opacity)
    weight = pull.detach().numpy().astype(np.float64).copy()
    dead = (opacity < DEAD_OPACITY) | (log_extent.min(1) <= smallest_log_extent + 1e-6)
    weight[dead] = 0
    candidates = int((weight > 0).sum())
    extra = min(growth.cap - count, int(np.ceil(growth.rate * count)))
    wanted = min(candidates, max(0, extra) + int(dead.sum()))
    if wanted == 0:
        empty = np.zeros(0, dtype=np.int64)
        return empty, empty, {"center": np.zeros((2, 0, 3)), "log_extent": np.zeros((2, 0, 3))}
    # Drawing without replacement in proportion to the weight: the largest of log(u) / weight (Efraimidis and Spirakis 2006).
    with np.errstate(divide="ignore"):
        keys = np.where(weight > 0, np.log(rng.random(count)) / np.where(weight > 0, weight, 1), -np.inf)
    parents = np.sort(np.argpartition(-keys, wanted - 1)[:wanted])
    recycled = np.flatnonzero(dead)[:wanted]
    children = np.concatenate([recycled, count + np.arange(wanted - len(recycled))])

    extent = np.exp(log_extent[parents])
    axis = (rng.random((wanted, 1)) > np.cumsum(extent**2, 1)[:, :2] / (extent**2).sum(1, keepdims=True)).sum(
        1
    )
    chosen = np.eye(3)[axis]
    offset = _rotate(
        parameters["rotation"].detach().numpy()[parents].astype(np.float64), SPLIT_OFFSET * extent * chosen
    )
    center = parameters["center"].detach().numpy()[parents].astype(np.float64)
    shrunk = log_extent[parents] + np.log(np.where(chosen == 1, SPLIT_ALONG, SPLIT_ACROSS))
    return (
        parents,
        children,
        {"center": np.stack([center + offset, center - offset]), "log_extent": np.stack([shrunk, shrunk])},
    )


def _rotate(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    q = quaternion / np.maximum(np.linalg.norm(quaternion, axis=1, keepdims=True), 1e-30)
    w, u = q[:, :1], q[:, 1:]
    twice = 2 * np.cross(u, vector)
    return vector + w * twice + np.cross(u, twice)
