"""How much to do in a given time: the cost of a training step and of a voxel size, measured first, and what is chosen
from it."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field

from .errors import LinprimError

# Share of a budget that is planned for: what is left ends the program and takes up what the correction comes too late
# for.
AIM = 0.97
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
# Coarse passes of extraction take these multiples of the voxel that the views support, which is the finest that is
# chosen: half of it has 2 % more Chamfer distance and 17 times the open edges on the built-in part, for four times the
# time.
COARSE, FINEST = (4.0, 2.0), 1.0
# The first pass of all, which also loads libraries, is not counted.
WARM_UP = 8.0


@dataclass(frozen=True)
class Budget:
    """`seconds` of wall-clock time since `began`, a reading of time.monotonic()."""

    seconds: float
    began: float = field(default_factory=time.monotonic)

    def __post_init__(self):
        if not (math.isfinite(self.seconds) and self.seconds > 0):
            raise LinprimError(f"--time-budget is {self.seconds} s, wanted a positive time such as 90s or 5m")

    @staticmethod
    def of(given: Budget | float | None) -> Budget | None:
        """`given` itself, or a budget of so many seconds from now."""
        return given if given is None or isinstance(given, Budget) else Budget(float(given))

    def elapsed(self) -> float:
        """Seconds since it began."""
        return time.monotonic() - self.began

    def left(self) -> float:
        """Seconds that may still be planned for; negative if there are none."""
        return AIM * self.seconds - self.elapsed()


@dataclass(frozen=True)
class StepCost:
    """Seconds of one training step: `base` + `per_primitive` times the number of primitives; `late` times that in the
    share `late_share` of the run that has more terms or a dearer order."""

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


@dataclass(frozen=True)
class VoxelCost:
    """Seconds of fusing and finishing with a voxel of size v: `base` + `per_area` / v^2, for what lies along a
    surface."""

    base: float
    per_area: float

    @staticmethod
    def fit(passes: Sequence[tuple[float, float]]) -> VoxelCost:
        """Through one or two (voxel size, seconds), from coarse to fine. One alone counts as area in full, which is the
        dearer guess; so do two of which the finer was not slower."""
        v, t = passes[-1]
        if len(passes) > 1:
            (u, s), (v, t) = passes[-2:]
            slope = (t - s) / (1 / v**2 - 1 / u**2)
            if slope > 0 and slope / v**2 <= t:
                return VoxelCost(t - slope / v**2, slope)
        return VoxelCost(0.0, t * v**2)

    def seconds(self, voxel: float) -> float:
        """Of fusing and finishing."""
        return self.base + self.per_area / voxel**2


def plan_voxel(seconds: float, cost: VoxelCost, finest: float, coarsest: float) -> float | None:
    """The smallest voxel size in [finest, coarsest] that takes at most `seconds`, to three digits; None if none
    does."""
    if cost.seconds(coarsest) > seconds:
        return None
    voxel = max(finest, math.sqrt(cost.per_area / max(seconds - cost.base, 1e-12)))
    digit = 10.0 ** (math.floor(math.log10(voxel)) - 2)
    return min(coarsest, max(finest, math.ceil(voxel / digit - 1e-9) * digit))


def choose_voxel(run, options, target, stages, budget: Budget):
    """Measures coarse passes of the TSDF surface and chooses the voxel size that fills the budget.

    Args:
        run: an open run. options: ExtractOptions with a level that is a number. target: the file that will be written.

    Returns: (ExtractOptions with the voxel size, the depth maps that were rendered, what was chosen and why for the
    statistics).

    Raises:
        LinprimError: not even the coarsest voxel fits; no ray crosses the level.
    """
    from dataclasses import replace

    from .fuse import auto_voxel_size
    from .surface_tsdf import DepthFrames

    begin = time.monotonic()
    frames = DepthFrames(run, options.level, options.depth_limit)
    supported = auto_voxel_size(frames)
    stages.lap("render")
    rendering = time.monotonic() - begin
    passes: list[tuple[float, float]] = []
    for multiple in (WARM_UP, *COARSE):
        voxel = multiple * supported
        if passes and budget.left() < (passes[0][0] / voxel) ** 2 * passes[0][1]:
            break  # a second pass might leave no time for the surface itself
        try:
            seconds = _timed_pass(run, replace(options, voxel_size=voxel), frames, target, stages)
        except LinprimError:  # too coarse for a surface
            if multiple == COARSE[-1]:
                raise
            continue
        if multiple != WARM_UP:
            passes.append((voxel, seconds))
    stages.lap("coarse passes")
    cost = VoxelCost.fit(passes)
    left, coarsest, finest = budget.left(), passes[0][0], FINEST * supported
    voxel = plan_voxel(left, cost, finest, coarsest)
    if voxel is None:
        least = (budget.elapsed() + cost.seconds(coarsest)) / AIM
        raise LinprimError(
            f"--time-budget is {budget.seconds:.3g} s, but the coarsest surface of this run, voxels of "
            f"{coarsest:.2g}, takes {least:.0f} s"
        )
    why = "fills the time"
    if voxel <= 1.001 * finest:
        why = "what the views support: a finer one shows nothing more"
    elif voxel >= 0.999 * coarsest:
        why = "the coarsest that is taken"
    predicted = cost.seconds(voxel)
    stages.note(
        f"voxel size {voxel:.3g}, {why}: {predicted:.1f} s of the {budget.seconds:.3g} s after "
        f"{budget.elapsed():.1f} s "
        f"({supported:.3g} is what the views support)"
    )
    chosen = {
        "seconds": budget.seconds,
        "voxel_size": voxel,
        "why": why,
        "supported_voxel_size": supported,
        "render_seconds": rendering,
        "coarse_passes": [{"voxel_size": v, "seconds": t} for v, t in passes],
        "cost": asdict(cost),
        "predicted_seconds": predicted,
        "aim_seconds": AIM * budget.seconds,
    }
    return replace(options, voxel_size=voxel), frames, chosen


def _timed_pass(run, options, frames, target, stages) -> float:
    """Seconds of everything that follows the depth maps, written to a folder that is thrown away."""
    import tempfile
    from pathlib import Path

    from .finish import finish_surface
    from .progress import Progress
    from .stages import Stages
    from .surface_tsdf import tsdf_surface

    quiet = Stages(Progress("coarse pass", 1, quiet=True))
    with tempfile.TemporaryDirectory(prefix="linprim_geo_") as folder:
        begin = time.monotonic()
        mesh, _ = tsdf_surface(run, options, quiet, frames)
        mesh = finish_surface(mesh, run, options, Path(folder) / target.name, quiet).mesh
        seconds = time.monotonic() - begin
    stages.note(f"coarse pass with voxels of {options.voxel_size:.3g}: {seconds:.2f} s, {len(mesh.faces)} triangles")
    return seconds
