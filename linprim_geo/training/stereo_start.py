"""Where stereo finds surfaces, a training starts on them."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from linprim_geo.base.budget import Budget
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import TrainOptions, initial_count
from linprim_geo.base.progress import Progress, duration
from linprim_geo.capture.types import PointCloud, Scene, View
from linprim_geo.points.initial_points import VolumePoints
from linprim_geo.points.start_points import SFM_START
from linprim_geo.stereo.planes_on_disk import Photographs
from linprim_geo.stereo.surface_points import small_copies, surface_points
from linprim_geo.stereo.time_plan import seconds_per_pixel

# Of a time budget stereo takes at most this share; steps in the rest are fewer and as long as before.
BUDGET_SHARE = 0.2


def stereo_start(
    scene: Scene, options: TrainOptions, progress: Progress, budget: Budget | None = None
) -> PointCloud | None:
    """Points on surfaces, as many as the scene has fewer than a training starts with, by stereo of its training views.

    None where it has enough, where its points are anywhere in a volume, and where stereo has nothing to say.
    """
    if options.start != "stereo" or scene.points is None or isinstance(scene.points, VolumePoints):
        return None
    missing = initial_count(options, SFM_START) - len(scene.points.xyz)
    if missing <= 0:
        return None
    begin = time.monotonic()
    views, points = small_copies(scene.train), scene.points.xyz
    try:
        if budget and not _fits(views, points, budget):
            progress.note(f"start: stereo would take more than {BUDGET_SHARE:.0%} of the time that is left")
            return None
        found, share = surface_points(views, points, missing, options.seed, quiet=progress.quiet)
    except LinprimError as error:
        progress.note(f"start: no stereo, {error}")
        return None
    progress.note(
        f"start: stereo of {len(views)} photographs, averaged down, finds surfaces in {share:.0%} of the pixels "
        f"({duration(time.monotonic() - begin)})"
    )
    return found


def _fits(views: Sequence[View], points: np.ndarray, budget: Budget) -> bool:
    """Whether stereo takes no more than BUDGET_SHARE of what is left, by its first photographs."""
    rate = seconds_per_pixel(Photographs(views, points), budget)
    pixels = sum(view.camera.width * view.camera.height for view in views)
    return rate * pixels <= BUDGET_SHARE * budget.left()
