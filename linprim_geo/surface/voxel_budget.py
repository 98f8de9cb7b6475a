"""Chooses the voxel size that a time budget allows, from the measured time of coarse passes."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from linprim_geo.base.budget import AIM, Budget
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.progress import Progress, Stages
from linprim_geo.surface.postprocess import finish_surface, with_rounds

# Voxel sizes of the coarse passes, and the finest that is chosen, as multiples of the one that the views support. Half
# of that one has 2 % more Chamfer distance and 17 times the open edges on the built-in part, for four times the time.
PASS_MULTIPLES, FINEST = (4.0, 2.0), 1.0
# Voxel size, as a multiple, of a first pass with the cheapest options, which loads libraries and is not counted.
WARM_UP = 8.0
# Time that is kept from stereo, in times of that first pass. With stereo a pass takes three times as long, as two
# surfaces are fused and compared and one is denoised, and there are two: a coarse one and that of the result.
RESERVED = 6


@dataclass(frozen=True)
class VoxelCost:
    """Seconds of fusing and finishing with a voxel of size v: `base` + `per_area` / v^2, as the voxels lie along a
    surface."""

    base: float
    per_area: float

    @staticmethod
    def fit(passes: Sequence[tuple[float, float]]) -> VoxelCost:
        """Fit the cost to one or two (voxel size, seconds), from coarse to fine. One alone counts as area in full,
        which is the more expensive guess; so do two of which the finer was not slower."""
        v, t = passes[-1]
        if len(passes) > 1:
            (u, s), (v, t) = passes[-2:]
            slope = (t - s) / (1 / v**2 - 1 / u**2)
            if slope > 0 and slope / v**2 <= t:
                return VoxelCost(t - slope / v**2, slope)
        return VoxelCost(0.0, t * v**2)

    def seconds(self, voxel: float) -> float:
        """Return the seconds of fusing and finishing."""
        return self.base + self.per_area / voxel**2


def plan_voxel(seconds: float, cost: VoxelCost, finest: float, coarsest: float) -> float | None:
    """Return the smallest voxel size in [finest, coarsest] that takes at most `seconds`, to three digits; None if none
    does."""
    if cost.seconds(coarsest) > seconds:
        return None
    voxel = max(finest, math.sqrt(cost.per_area / max(seconds - cost.base, 1e-12)))
    digit = 10.0 ** (math.floor(math.log10(voxel)) - 2)
    return min(coarsest, max(finest, math.ceil(voxel / digit - 1e-9) * digit))


def choose_voxel(run, options, target, stages, budget: Budget):
    """Measure coarse passes of the TSDF surface, and choose the voxel size that fills the budget.

    Args:
        run: an open run. options: ExtractOptions with a level that is a number. target: the file that will be written.

    Returns: (ExtractOptions with the voxel size and whether there is stereo, depth maps as keywords of
        `method_tsdf.tsdf_surface`, what was chosen and why for the statistics).

    Raises:
        LinprimError: not even the coarsest voxel fits; no ray crosses the level.
    """
    from linprim_geo.surface.fusion.tsdf_fusion import auto_voxel_size
    from linprim_geo.surface.methods.method_tsdf import DepthFrames
    from linprim_geo.surface.stereo_budget import stereo_in_time

    begin = time.monotonic()
    frames = DepthFrames(run, options.level, options.depth_limit)
    stages.lap("render")
    rendering = time.monotonic() - begin
    kept: dict = {"frames": frames}
    cheapest = replace(options, voxel_size=WARM_UP * auto_voxel_size(frames), stereo="off", refine=0, denoise="off")
    begin = time.monotonic()
    with suppress(LinprimError):  # too coarse for a surface
        _timed_pass(run, cheapest, kept, target)
    reserve = RESERVED * (time.monotonic() - begin)
    stages.lap("coarse passes")
    stereo: dict = {}
    if options.stereo != "off":
        kept["frames"], kept["merged"], stereo = stereo_in_time(run, options, frames, stages, budget, reserve)
        options = replace(options, stereo=options.stereo if stereo else "off")
    supported = auto_voxel_size(kept["frames"])
    passes: list[tuple[float, float]] = []
    for multiple in PASS_MULTIPLES:
        voxel = multiple * supported
        if passes and budget.left() < (passes[0][0] / voxel) ** 2 * passes[0][1]:
            break  # a second pass might leave no time for the surface itself
        try:
            seconds = _timed_pass(run, replace(options, voxel_size=voxel), kept, target)
        except LinprimError:  # too coarse for a surface
            if multiple == PASS_MULTIPLES[-1]:
                raise
            continue
        passes.append((voxel, seconds))
        stages.note(f"coarse pass with voxels of {voxel:.3g}: {seconds:.2f} s")
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
        "stereo": stereo,
        "coarse_passes": [{"voxel_size": v, "seconds": t} for v, t in passes],
        "cost": asdict(cost),
        "predicted_seconds": predicted,
        "aim_seconds": AIM * budget.seconds,
    }
    return replace(options, voxel_size=voxel), kept, chosen


def _timed_pass(run, options, kept, target) -> float:
    """Return the seconds of everything that follows the `kept` depth maps; the result goes to a temporary folder."""
    from linprim_geo.surface.methods.method_tsdf import tsdf_surface

    quiet = Stages(Progress("coarse pass", 1, quiet=True))
    with tempfile.TemporaryDirectory(prefix="linprim_geo_") as folder:
        begin = time.monotonic()
        mesh, about = tsdf_surface(run, options, quiet, **kept)
        finish_surface(mesh, run, with_rounds(options, about), Path(folder) / target.name, quiet)
        return time.monotonic() - begin
