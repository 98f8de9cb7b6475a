"""How many steps and primitives fit into a given time, by the measured cost of a training step."""

from __future__ import annotations

import math
from dataclasses import dataclass

# Steps per primitive of a run that is planned freely, the best of four at equal time on the built-in part (40 views of
# 128 px, 20 s of one core): 0.12, 0.35, 1.4 and 5.6 give Chamfer distances of 0.247, 0.244, 0.303 and 0.421 % of the
# diagonal, and 32.9, 33.7, 33.2 and 30.7 dB. `train`'s own defaults have it too.
STEPS_PER_PRIMITIVE = 0.35
# Less than this gives no surface worth a name.
LEAST_STEPS, LEAST_PRIMITIVES = 300, 300
# More primitives than one in so many pixels of all training views are not fixed by them.
PIXELS_PER_PRIMITIVE = 20
# Growth ends at this part of a run and has reached its limit at 0.9 of that (population.Growth).
GROWTH_END, FULL_AT = 0.6, 0.54
# The correction when growth has ended changes the steps that are left by at most this factor, up or down.
LARGEST_CORRECTION = 10.0
# Writing a checkpoint and the exported scene, before it has been measured.
SAVE_SECONDS = 0.3


@dataclass(frozen=True)
class StepCost:
    """Seconds of one training step: `base` + `per_primitive` times the number of primitives; `late` times that in the
    share `late_share` of the run that has more terms or a more expensive order."""

    base: float
    per_primitive: float
    late: float = 1.0
    late_share: float = 0.0

    @staticmethod
    def fit(small: tuple[int, float], large: tuple[int, float], late: float = 1.0, late_share: float = 0.0) -> StepCost:
        """Through two (primitives, seconds). Where the larger was not slower, a step costs their mean at any number."""
        (n, s), (m, t) = small, large
        slope = (t - s) / (m - n) if m > n else 0.0
        if slope <= 0:
            return StepCost((s + t) / 2, 0.0, late, late_share)
        if slope * n > s:  # more than in proportion: a line through zero
            return StepCost(0.0, t / m, late, late_share)
        return StepCost(s - slope * n, slope, late, late_share)

    def seconds(self, primitives: float) -> float:
        """Of a step, on average over the run."""
        return (self.base + self.per_primitive * primitives) * (1 + self.late_share * (self.late - 1))


@dataclass(frozen=True)
class TrainingPlan:
    """Training steps, the limit of the population, the seconds that the steps should take, and why."""

    iterations: int
    max_primitives: int
    seconds: float
    why: str


def mean_population(start: float) -> float:
    """Mean number of primitives over a run, as a share of the limit, of one that begins with the share `start` and
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
    """Steps and population for `seconds` of training steps; None where not even LEAST_STEPS of LEAST_PRIMITIVES fit.

    With P primitives at most, S = r P steps (r = STEPS_PER_PRIMITIVE) of (base + per_primitive m P) each fill the time,
    m the mean population as a share of P: a quadratic in P. If that is less than LEAST_STEPS there are as many, of
    fewer primitives, but no less than LEAST_PRIMITIVES; if P is more than `most`, it is that, and the steps fill the
    time.

    Args:
        start: population at the start, as a share of its limit.
        iterations, max_primitives: given ones are kept, and the other follows from the time.
    """
    if seconds <= 0:
        return None
    share = mean_population(start)
    factor = cost.seconds(0) / cost.base if cost.base > 0 else 1 + cost.late_share * (cost.late - 1)
    a, b = cost.base * factor, cost.per_primitive * factor * share
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
    """Seconds of the least training that `plan_training` plans."""
    return (iterations or LEAST_STEPS) * cost.seconds(max_primitives or LEAST_PRIMITIVES)


def corrected_steps(step: int, iterations: int, per_step: float, left: float) -> int:
    """Steps of the whole run, at `step` of `iterations` planned ones, so that the rest of `per_step` seconds each fills
    `left`."""
    rest = max(1, iterations - step)
    wanted = left / per_step if per_step > 0 else rest
    return step + int(min(max(wanted, rest / LARGEST_CORRECTION, 1), rest * LARGEST_CORRECTION))
