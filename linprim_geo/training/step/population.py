"""How the number of primitives grows: the primitives with the largest screen-space gradient are cut in two.

Parents are drawn in proportion to the screen-space gradient accumulated since the last event. Primitives that have
become transparent or have shrunk to nothing are not deleted but become the second half of another parent. The rules of
the papers that this is compared with are in population_papers.py; what they all have in common is `DensityControl`.
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

# The part of a run's steps after which the population stays.
GROWS_UNTIL = 0.6
# A primitive whose opacity along its reference length is below this is moved to where it is needed.
DEAD_OPACITY = 0.005


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
        """Events every 100 steps (60 in all of a shorter run) from 3 % of the run to GROWS_UNTIL.

        The rate brings `start` to `cap` a little before the last event.
        """
        every = max(10, min(100, iterations // 60))
        first, last = max(every, round(0.03 * iterations)), round(GROWS_UNTIL * iterations)
        events = max(1, (last - first) // every)
        rate = max(0.02, (max(cap, start) / max(1, start)) ** (1 / (0.9 * events)) - 1)
        return Growth(first, last, every, min(rate, 0.25), cap)

    def is_due(self, step: int) -> bool:
        """Whether the population changes after this step."""
        return self.first <= step <= self.last and step % self.every == 0


@dataclass(frozen=True)
class Event:
    """One change of the population, N primitives before it and M after it.

    Row i of the new tables, Adam's moments included, is row `source[i]` of the old ones; then `values[name]`, pairs of
    rows of the new table and what they receive, is written. First moments become 0 in the rows `reset_momentum`, both
    in the rows `reset_state`, and both of the opacity everywhere with `reset_opacity`.
    """

    source: np.ndarray
    values: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    reset_momentum: np.ndarray | None = None
    reset_state: np.ndarray | None = None
    reset_opacity: bool = False


class DensityControl:
    """A rule of growth. Whatever it draws comes from (seed, purpose, step), so that a resumed run repeats itself.

    `accumulated` holds a value per primitive for each name in `NAMES`; the trainer saves it and sets it to 0 after each
    event.
    """

    NAMES: tuple[str, ...] = ()
    # The part of a run's steps after which there are no more events.
    GROWS_UNTIL: float

    def __init__(self, options: TrainOptions, count: int, cameras: list[Camera], bounds: tuple[float, float]):
        """`count` primitives at the start, the training `cameras`, and the `bounds` that extents stay within."""
        self.options, self.bounds = options, bounds
        self.kind = options.primitive
        self.reset(count)

    def reset(self, count: int) -> None:
        """Forgets what was accumulated; there are `count` primitives now."""
        self.accumulated = {name: torch.zeros(count) for name in self.NAMES}

    def rng(self, purpose: int, step: int) -> np.random.Generator:
        """The generator of this purpose at this step."""
        return np.random.default_rng([self.options.seed, purpose, step])

    def penalty(self, parameters: Parameters) -> torch.Tensor | None:
        """What is added to the loss, differentiable in the raw parameters."""
        return None

    def accumulate(
        self, parameters: Parameters, camera: Camera, size: tuple[int, int], screen_grad: torch.Tensor
    ) -> None:
        """Notes one view's gradient to the projected centres (N, 3), see `ops.rasterize`'s `screen`; `size`, (width,
        height), is that of the photograph, of which the camera may see a part."""

    def add_noise(self, parameters: Parameters, step: int) -> None:
        """Changes parameters in place after the optimiser's step, `step` counted from 1."""

    def is_due(self, step: int) -> bool:
        """Whether the population changes after this step."""
        raise NotImplementedError

    def grow(self, parameters: Parameters, step: int) -> Event:
        """The change after this step."""
        raise NotImplementedError

    def limit_only(
        self, counts: Callable[[np.ndarray], np.ndarray], most: int, parameters: Parameters, step: int
    ) -> None:
        """Limits to `most` those alone whose centres (N, 3) `counts` says (N,) True of, where a rule can; the others
        limit all.

        To be called with the parameters and the step that a training, or its resumption, begins with.
        """

    def state(self) -> list[float]:
        """Numbers that follow from the run's start and not from its options."""
        return []

    def restore(self, numbers: list[float]) -> None:
        """Takes back what `state` returned."""


class GradientControl(DensityControl):
    """This file's rule: `grow` at the steps of a plan."""

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
        # In units of the image's size, so that views of different resolution count alike.
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
        # A child is its parent, moments and all, but for what a half has of its own.
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
    """Draws the parents of one event and computes their halves.

    Args:
        parameters: raw trainable tensors, `center` (N, 3), `rotation` (N, 4), `log_extent` (N, 3 or 4), `raw_opacity`
            (N,), ...
        screen_gradient: (N,) screen-space gradient accumulated since the last event, >= 0.
        smallest_log_extent: a primitive with an extent at this floor counts as dead.
        counted: primitives that count towards the cap; default: all.

    Returns: rows (P,) of the parents, overwritten by their first halves; rows (P,) that receive the second halves, from
        N on where they are new; and what the halves have of their own, {"center": (2, P, 3), "log_extent": (2, P, 3 or
        4), for Gaussians also "raw_opacity": (2, P)}. All other parameters of a half are its parent's.
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
    # Drawing without replacement in proportion to the weight: the largest of log(u) / weight (Efraimidis and Spirakis
    # 2006).
    with np.errstate(divide="ignore"):
        keys = np.where(weight > 0, np.log(rng.random(count)) / np.where(weight > 0, weight, 1), -np.inf)
    parents = np.sort(np.argpartition(-keys, wanted - 1)[:wanted])
    recycled = np.flatnonzero(dead)[:wanted]
    children = np.concatenate([recycled, count + np.arange(wanted - len(recycled))])
    center = parameters["center"].detach().numpy()[parents].astype(np.float64)
    rotation = parameters["rotation"].detach().numpy()[parents].astype(np.float64)
    raw_opacity = parameters["raw_opacity"].detach().numpy()[parents]
    return parents, children, KINDS[kind].halves(center, rotation, log_extent[parents], raw_opacity, rng)
