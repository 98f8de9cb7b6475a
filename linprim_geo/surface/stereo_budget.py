"""Runs stereo in a given time, on photographs that are downscaled until it fits."""

from __future__ import annotations

import time

from linprim_geo.base.budget import Budget
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import ExtractOptions
from linprim_geo.base.progress import Stages
from linprim_geo.capture.small_copy import SmallCopy
from linprim_geo.runs.run import Run
from linprim_geo.stereo.dense.planes_on_disk import Photographs
from linprim_geo.stereo.dense.time_plan import seconds_per_pixel
from linprim_geo.surface.fusion.stereo_frames import MergedFrames, pairing_points
from linprim_geo.surface.fusion.tsdf_fusion import auto_voxel_size
from linprim_geo.surface.methods.method_tsdf import (
    SMALLEST_SIDE,
    DepthFrames,
    check_stereo_memory,
    stereo_bytes,
    stereo_room,
    with_far_depths,
)

# Largest share of the remaining time for stereo: the rest is for smaller voxels.
SHARE = 0.5
# Time of stereo with its planes, relative to its depth maps alone, from which it is estimated: 1.1 and 1.3 times on
# `temple_ring`.
WITH_PLANES = 1.2


def stereo_in_time(
    run: Run, options: ExtractOptions, frames: DepthFrames, stages: Stages, budget: Budget, reserve: float
) -> tuple[DepthFrames, MergedFrames | None, dict]:
    """Return depth frames of a run, and these merged with stereo, of views as large as time and memory allow.

    Views have means of K by K pixels, with the least K that fits and leaves at least SMALLEST_SIDE pixels. If there is
    no time for any, or stereo is impossible, the given `frames` and None are returned. `reserve` seconds are kept from
    stereo in any case.

    Returns: the frames, the merged ones, and for the statistics K as `downscale`, and the seconds that stereo was
        planned to take and took.

    Raises:
        LinprimError: `options.stereo` is on, and there is no stereo.
    """
    try:
        rate = WITH_PLANES * seconds_per_pixel(Photographs(frames.views, pairing_points(frames)), budget)
        cameras = [view.camera for view in frames.views]
        pixels = sum(camera.width * camera.height for camera in cameras)
        largest = max(1, min(max(camera.width, camera.height) for camera in cameras) // SMALLEST_SIDE)
        room = stereo_room(options)
        factors = [factor for factor in range(1, largest + 1) if stereo_bytes(cameras) <= room * factor**2]
        if not factors:
            check_stereo_memory(cameras, options)
        planned = {factor: rate * pixels / factor**2 for factor in factors}
        most = min(SHARE * budget.left(), budget.left() - reserve)
        fitting = [factor for factor, seconds in planned.items() if seconds <= most]
        if not fitting:
            raise LinprimError(
                f"--time-budget is {budget.seconds:.3g} s, which leaves {max(most, 0):.0f} s for stereo, and the least "
                f"that is of any use takes {planned[factors[-1]]:.0f} s"
            )
        factor, own = fitting[0], frames
        if factor > 1:
            views = [SmallCopy.of(view, factor) for view in frames.views]
            own = DepthFrames(run, float(options.level), frames.limit, views=views)
        begin = time.monotonic()
        merged = with_far_depths(own, options, auto_voxel_size(own)).merged(quiet=stages.progress.quiet)
    except LinprimError as error:
        if options.stereo == "on":
            raise
        stages.note(f"no stereo: {error}")
        return frames, None, {}
    taken = time.monotonic() - begin
    stages.note(f"stereo of means of {factor} by {factor} pixels" if factor > 1 else "stereo of whole photographs")
    stages.lap("stereo")
    return own, merged, {"downscale": factor, "planned_seconds": planned[factor], "seconds": taken}
