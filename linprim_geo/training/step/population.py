"""Density control: primitives with the largest screen-space gradient are split in two.

Parents are drawn with probability in proportion to the screen-space gradient accumulated since the last event.
Primitives that have become transparent or have reached the smallest extent are not deleted but reused as the second
half of a parent. `DensityControl` is the interface; population_papers.py has the rules of the papers used for
comparison.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch

from linprim_geo.base.kinds import KINDS
from linprim_geo.base.options import TrainOptions
from linprim_geo.geometry.camera import Camera

Parameters = dict[str, torch.Tensor]

# Share of a run's steps after which the number of primitives stays constant.
GROWS_UNTIL = 0.6
# A primitive whose opacity along its reference length is below this counts as dead and is reused elsewhere.
DEAD_OPACITY = 0.005


@dataclass(frozen=True)
class Growth:
    """Schedule of density control. Steps are training iterations."""

    first: int
    last: int
    every: int
    rate: float  # growth per event, as a share of the current count
    cap: int

    @staticmethod
    def plan(iterations: int, start: int, cap: int) -> Growth:
        """Return a schedule with an event every 100 steps (in runs of fewer than 6000 steps every 1/60 of the run, but
        at least 10 steps apart) from 3 % of the run to GROWS_UNTIL.

        The rate is chosen so that `start` primitives reach `cap` shortly before the last event.
        """
        every = max(10, min(100, iterations // 60))
        first, last = max(every, round(0.03 * iterations)), round(GROWS_UNTIL * iterations)
        events = max(1, (last - first) // every)
        rate = max(0.02, (max(cap, start) / max(1, start)) ** (1 / (0.9 * events)) - 1)
        return Growth(first, last, every, min(rate, 0.25), cap)

    def is_due(self, step: int) -> bool:
        """Return whether density control acts after this step."""
        return self.first <= step <= self.last and step % self.every == 0


@dataclass(frozen=True)
class Event:
    """One change of the population from N to M primitives.

    Row i of the new tables, Adam's moments included, is copied from row `source[i]` of the old ones. Then
    `values[name]`, a pair (rows of the new table, their new values), is written. First moments are zeroed in the rows
    `reset_momentum`, both moments in the rows `reset_state`, and with `reset_opacity` both moments of the opacity in
    all rows.
    """

    source: np.ndarray
    values: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    reset_momentum: np.ndarray | None = None
    reset_state: np.ndarray | None = None
    reset_opacity: bool = False


class DensityControl:
    """Interface of a density control rule.

    All random numbers are seeded by (seed, purpose, step), so a resumed run repeats the same choices. `accumulated`
    holds one value per primitive for each name in `NAMES`; the trainer saves it and resets it to 0 after each event.
    """

    NAMES: tuple[str, ...] = ()
    # Share of a run's steps after which there are no more events.
    GROWS_UNTIL: float

    def __init__(self, options: TrainOptions, count: int, cameras: list[Camera], bounds: tuple[float, float]):
        """`count` initial primitives, the training `cameras`, and the `bounds` of extents."""
        self.options, self.bounds = options, bounds
        self.kind = options.primitive
        self.reset(count)

    def reset(self, count: int) -> None:
        """Clear the accumulated values; there are now `count` primitives."""
        self.accumulated = {name: torch.zeros(count) for name in self.NAMES}

    def rng(self, purpose: int, step: int) -> np.random.Generator:
        """Return the random generator for a purpose at a step."""
        return np.random.default_rng([self.options.seed, purpose, step])

    def penalty(self, parameters: Parameters) -> torch.Tensor | None:
        """Return a term that is added to the loss, differentiable in the raw parameters, or None."""
        return None

    def accumulate(
        self, parameters: Parameters, camera: Camera, size: tuple[int, int], screen_grad: torch.Tensor
    ) -> None:
        """Accumulate one view's gradient to the projected centres (N, 3), see `screen` of `ops.rasterize`. `size` is
        (width, height) of the whole photograph, of which the camera may show a part."""

    def add_noise(self, parameters: Parameters, step: int) -> None:
        """Add noise to parameters in place after the optimiser's step. `step` is counted from 1."""

    def is_due(self, step: int) -> bool:
        """Return whether density control acts after this step."""
        raise NotImplementedError

    def grow(self, parameters: Parameters, step: int) -> Event:
        """Return the change of the population after this step."""
        raise NotImplementedError

    def limit_only(
        self, counts: Callable[[np.ndarray], np.ndarray], most: int, parameters: Parameters, step: int
    ) -> None:
        """Apply the limit `most` only to primitives for whose centres (N, 3) `counts` returns True (N,), if the rule
        supports that. Other rules limit all primitives.

        Call it with the parameters and the step at which a training, or its resumption, begins.
        """

    def state(self) -> list[float]:
        """Return numbers that depend on the start of the run and cannot be derived from its options."""
        return []

    def restore(self, numbers: list[float]) -> None:
        """Restore what `state` returned."""


class GradientControl(DensityControl):
    """The default rule: split by screen-space gradient, with `grow`, at the steps of a schedule."""

    NAMES = ("screen_gradient",)
    GROWS_UNTIL = GROWS_UNTIL

    def __init__(self, options, count, cameras, bounds):
        super().__init__(options, count, cameras, bounds)
        self.growth = Growth.plan(options.iterations, count, options.max_primitives)
        self.counts: Callable[[np.ndarray], np.ndarray] | None = None

    def limit_only(self, counts, most, parameters, step):
        self.counts = counts
        if step == 0:
            self.growth = Growth.plan(
                self.options.iterations, int(counts(parameters["center"].detach().numpy()).sum()), most
            )

    def accumulate(self, parameters, camera, size, screen_grad):
        # Gradients are scaled to units of the image's size, so that views of different resolution count alike.
        self.accumulated["screen_gradient"] += screen_grad[:, 2] * max(size)

    def is_due(self, step):
        return self.growth.is_due(step)

    def grow(self, parameters, step):
        parents, children, halves = grow(
            parameters,
            self.accumulated["screen_gradient"],
            self.growth,
            math.log(self.bounds[0]),
            self.rng(5, step),
            self.kind,
            None if self.counts is None else int(self.counts(parameters["center"].detach().numpy()).sum()),
        )
        count = len(self.accumulated["screen_gradient"])
        source = np.arange(max(count, int(children.max(initial=-1)) + 1))
        source[children] = parents
        rows = np.concatenate([parents, children])
        # Children copy their parent's parameters and moments, except for the values that `halves` sets.
        values = {name: (rows, np.concatenate([both[0], both[1]])) for name, both in halves.items()}
        return Event(source, values, reset_momentum=rows)

    def state(self):
        return [self.growth.first, self.growth.last, self.growth.every, self.growth.rate, self.growth.cap]

    def restore(self, numbers):
        first, last, every, rate, cap = numbers
        self.growth = Growth(int(first), int(last), int(every), float(rate), int(cap))


def grow(
    parameters: Parameters,
    screen_gradient: torch.Tensor,
    growth: Growth,
    smallest_log_extent: float,
    rng: np.random.Generator,
    kind: str = "octahedron",
    counted: int | None = None,
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Draw the parents of one event and compute their halves.

    Args:
        parameters: raw trainable tensors: `center` (N, 3), `rotation` (N, 4), `log_extent` (N, 3 or 4), `raw_opacity`
            (N,), ...
        screen_gradient: (N,) screen-space gradient accumulated since the last event, >= 0.
        smallest_log_extent: a primitive with an extent at this lower bound counts as dead.
        counted: number of primitives that count towards the cap; default: all.

    Returns: rows (P,) of the parents, which are overwritten by their first halves; rows (P,) that receive the second
    halves, from N on if they are new; and the new parameters of both halves, {"center": (2, P, 3), "log_extent": (2, P,
    3 or 4), for Gaussians also "raw_opacity": (2, P)}. All other parameters are copied from the parent.
    """
    log_extent = parameters["log_extent"].detach().numpy().astype(np.float64)
    opacity = 1 - np.exp(-np.logaddexp(0.0, parameters["raw_opacity"].detach().numpy().astype(np.float64)))
    count = len(opacity)
    weight = screen_gradient.detach().numpy().astype(np.float64).copy()
    dead = (opacity < DEAD_OPACITY) | (log_extent.min(1) <= smallest_log_extent + 1e-6)
    weight[dead] = 0
    candidates = int((weight > 0).sum())
    extra = min(growth.cap - (count if counted is None else counted), int(np.ceil(growth.rate * count)))
    wanted = min(candidates, max(0, extra) + int(dead.sum()))
    if wanted == 0:
        empty = np.zeros(0, dtype=np.int64)
        columns = log_extent.shape[1]
        return empty, empty, {"center": np.zeros((2, 0, 3)), "log_extent": np.zeros((2, 0, columns))}
    # Weighted sampling without replacement: take the largest keys log(u) / weight (Efraimidis and Spirakis 2006).
    with np.errstate(divide="ignore"):
        keys = np.where(weight > 0, np.log(rng.random(count)) / np.where(weight > 0, weight, 1), -np.inf)
    parents = np.sort(np.argpartition(-keys, wanted - 1)[:wanted])
    recycled = np.flatnonzero(dead)[:wanted]
    children = np.concatenate([recycled, count + np.arange(wanted - len(recycled))])
    center = parameters["center"].detach().numpy()[parents].astype(np.float64)
    rotation = parameters["rotation"].detach().numpy()[parents].astype(np.float64)
    raw_opacity = parameters["raw_opacity"].detach().numpy()[parents]
    return parents, children, KINDS[kind].halves(center, rotation, log_extent[parents], raw_opacity, rng)
