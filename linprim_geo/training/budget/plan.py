"""Choose the numbers of steps and primitives that fit into a given time, from the measured cost of a training step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

# Steps per primitive of a freely planned run. Best of four at equal time on the built-in part (40 views of 128 px, 20 s
# of one core): 0.12, 0.35, 1.4 and 5.6 give Chamfer distances of 0.247, 0.244, 0.303 and 0.421 % of the diagonal, and
# 32.9, 33.7, 33.2 and 30.7 dB. The defaults of `train` have the same ratio.
STEPS_PER_PRIMITIVE = 0.35
# Fewer steps or primitives than this give no useful surface.
LEAST_STEPS, LEAST_PRIMITIVES = 300, 300
# At most one primitive per this number of pixels of all training views; more would be underdetermined.
PIXELS_PER_PRIMITIVE = 20
# Growth ends at the share GROWTH_END of a run and reaches its limit at 0.9 of that, FULL_AT (population.Growth).
GROWTH_END, FULL_AT = 0.6, 0.54
# At the end of growth the number of remaining steps is changed by at most this factor, up or down.
LARGEST_CORRECTION = 10.0
# Assumed seconds to write a checkpoint and the exported scene, until they are measured.
SAVE_SECONDS = 0.3


@dataclass(frozen=True)
class StepCost:
    """Seconds of one training step: `base` + `per_primitive` times the number of primitives, times what its phase of
    the run costs.

    `phases` holds (share of the run from which on a phase lasts, relative cost of its steps), in order from share 0.
    Phases differ in the size of photographs, the terms of the loss and the order of blending.
    """

    base: float
    per_primitive: float
    phases: Sequence[Sequence[float]] = ((0.0, 1.0),)

    @staticmethod
    def fit(
        small: tuple[int, float], large: tuple[int, float], phases: Sequence[Sequence[float]] = ((0.0, 1.0),)
    ) -> StepCost:
        """Fit the line through two measurements (primitives, seconds). If the larger population was not slower, a step
        costs their mean for any number of primitives."""
        (n, s), (m, t) = small, large
        slope = (t - s) / (m - n) if m > n else 0.0
        if slope <= 0:
            return StepCost((s + t) / 2, 0.0, phases)
        if slope * n > s:  # the line would have a negative base: use a line through zero
            return StepCost(0.0, t / m, phases)
        return StepCost(s - slope * n, slope, phases)

    def seconds(self, primitives: float) -> float:
        """Return the seconds of a step, averaged over the run."""
        return (self.base + self.per_primitive * primitives) * self.mean()

    def mean(self, begin: float = 0.0, end: float = 1.0) -> float:
        """Return the mean relative cost of the steps between two different shares of the run."""
        ends = [*[share for share, _ in self.phases[1:]], 1.0]
        total = 0.0
        for (first, relative), last in zip(self.phases, ends, strict=True):
            total += relative * max(0.0, min(last, end) - max(first, begin))
        return total / (end - begin)


@dataclass(frozen=True)
class TrainingPlan:
    """Planned steps, the limit on primitives, the seconds that the steps should take, and the reason for the choice."""

    iterations: int
    max_primitives: int
    seconds: float
    why: str


def mean_population(start: float) -> float:
    """Return the mean number of primitives over a run, as a share of the limit, if it starts with the share `start` and
    grows exponentially."""
    if not 0 < start < 1:
        return 1.0
    return FULL_AT * (1 - start) / -math.log(start) + 1 - FULL_AT


def plan_training(
    seconds: float,
    cost: StepCost,
    start: float,
    most: int,
    iterations: int | None = None,
    max_primitives: int | None = None,
) -> TrainingPlan | None:
    """Return the steps and primitives that fill `seconds` of training steps, or None if not even LEAST_STEPS with
    LEAST_PRIMITIVES fit.

    With at most P primitives and m P of them on average, S = r P steps (r = STEPS_PER_PRIMITIVE) of (base +
    per_primitive m P) seconds each fill the time: a quadratic equation in P. If S is less than LEAST_STEPS, S is raised
    to it and P lowered, but not below LEAST_PRIMITIVES. If P exceeds `most`, P is `most`, and the number of steps fills
    the time.

    Args:
        start: initial population, as a share of its limit.
        most: largest number of primitives, by the pixels of the training views.
        iterations, max_primitives: a given one is kept, and the other follows from the time.
    """
    if seconds <= 0:
        return None
    share = mean_population(start)
    a, b = cost.base * cost.mean(), cost.per_primitive * cost.mean() * share
    least = max(1, min(LEAST_PRIMITIVES, most))
    if max_primitives is not None:
        cap, why = max_primitives, "the given limit of primitives"
    elif iterations is not None:
        cap = (seconds / iterations - a) / b if b > 0 else most
        why = "the given number of steps"
        if cap < least:
            return None
    else:
        per = seconds / STEPS_PER_PRIMITIVE
        cap = (math.sqrt(a * a + 4 * b * per) - a) / (2 * b) if b > 0 else per / a
        why = f"{STEPS_PER_PRIMITIVE:g} steps per primitive"
        if STEPS_PER_PRIMITIVE * cap < LEAST_STEPS:
            cap, why = ((seconds / LEAST_STEPS - a) / b if b > 0 else cap), f"{LEAST_STEPS} steps at least"
            if cap < least:
                return None
        if cap > most:
            why = f"one primitive for every {PIXELS_PER_PRIMITIVE} pixels"
    cap = max(1, int(cap)) if max_primitives is not None else int(min(max(cap, least), most))
    step = a + b * cap
    count = iterations if iterations is not None else int(seconds / step * (1 + 1e-9))
    if count < LEAST_STEPS and iterations is None:
        return None
    return TrainingPlan(count, cap, count * step, why)


def least_training(cost: StepCost, iterations: int | None = None, max_primitives: int | None = None) -> float:
    """Return the seconds of the smallest training that `plan_training` accepts."""
    return (iterations or LEAST_STEPS) * cost.seconds(max_primitives or LEAST_PRIMITIVES)


def corrected_steps(step: int, iterations: int, per_step: float, left: float) -> int:
    """Return the total number of steps so that the remaining ones, of `per_step` seconds each, fill `left` seconds. The
    run is at `step` of `iterations` planned ones."""
    rest = max(1, iterations - step)
    wanted = left / per_step if per_step > 0 else rest
    return step + int(min(max(wanted, rest / LARGEST_CORRECTION, 1), rest * LARGEST_CORRECTION))
