"""Run stereo on reduced training photographs, and turn it into initial points and depth supervision for training."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from linprim_geo.base.budget import Budget
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import TrainOptions, initial_count
from linprim_geo.base.progress import Progress, duration
from linprim_geo.capture.types import PointCloud, Scene, View
from linprim_geo.points.initial_points import VolumePoints
from linprim_geo.points.start_points import SFM_START
from linprim_geo.points.view_pairs import visible_pixels
from linprim_geo.stereo.dense.planes_on_disk import Photographs
from linprim_geo.stereo.dense.time_plan import seconds_per_pixel
from linprim_geo.stereo.evidence import CONFIRMED_DEPTH
from linprim_geo.stereo.surface_points import SurfaceMap, small_copies, surface_maps, surface_points

# Largest relative difference between a stereo depth and the depth of a capture point for the two to agree.
AGREE = 2 * CONFIRMED_DEPTH
# If more than this share of the points disagrees, the stereo depths are taken for chance matches and dropped: 0.88 of
# the points disagree in a hall without texture, 0.08 to 0.40 on eight other captures (DECISIONS 78).
CONTRADICTING = 2 / 3
# A scene is open if at least SKY_VIEWS views, and at least SKY_SHARE of all, show a sky: 4 of 22 and 6 of 28 views do
# in two captures of facades, none in eleven other captures (DECISIONS 89).
SKY_VIEWS, SKY_SHARE = 3, 0.1
# Stereo takes at most this share of the time that is left of a budget. The remaining time then has fewer training steps
# of the same length.
BUDGET_SHARE = 0.2


@dataclass(frozen=True)
class Surfaces:
    """What stereo of the training views found.

    `points`: additional initial points, as many as the scene is short of, or None if it has enough. `maps`: reduced
    depth maps of some views, used as supervision. `sky`: whether enough views show a sky; only determined if the
    background depends on it.
    """

    points: PointCloud | None = None
    maps: Sequence[SurfaceMap] = ()
    sky: bool = False


NO_SURFACES = Surfaces()


def stereo_surfaces(
    scene: Scene, options: TrainOptions, progress: Progress, budget: Budget | None = None, *, started: bool = False
) -> Surfaces:
    """Run stereo on the training views and return the surfaces that it finds.

    The result is empty if neither points nor supervision are wanted, if the scene's points are random ones in a volume,
    if stereo fails or does not fit the budget, or if the scene's points contradict it, as in rooms without texture
    where matches are chance. With masks there are no `maps`, because masks already clear the space in front of the
    background.

    Args:
        started: the training is being resumed and needs no points.
    """
    if scene.points is None or isinstance(scene.points, VolumePoints):
        return Surfaces()
    wanted = initial_count(options, SFM_START) if options.start == "stereo" and not started else 0
    missing = wanted - len(scene.points.xyz)
    held = options.stereo_depth > 0 and not scene.has_alpha
    if missing <= 0 and not held:
        return Surfaces()
    begin = time.monotonic()
    views, points = small_copies(scene.train), scene.points.xyz
    asked = options.background == "auto" and not started and not scene.has_alpha
    try:
        if budget and not _fits(views, points, budget):
            progress.note(f"no stereo: it would take more than {BUDGET_SHARE:.0%} of the time that is left")
            return Surfaces()
        maps = surface_maps(views, points, options.seed, skies=asked, quiet=progress.quiet)
    except LinprimError as error:
        progress.note(f"no stereo: {error}")
        return Surfaces()
    share = sum(int(found.known.sum()) for found in maps) / sum(found.known.size for found in maps)
    progress.note(
        f"stereo of {len(views)} photographs, averaged down, finds surfaces in {share:.0%} of the pixels "
        f"({duration(time.monotonic() - begin)})"
    )
    if contradicting(maps, points) > CONTRADICTING:
        progress.note("no stereo: it is elsewhere than most points of the capture")
        return Surfaces()
    cloud = surface_points(maps, missing, options.seed) if missing > 0 else None
    skies = sum(found.shows_sky for found in maps)
    sky = skies >= max(SKY_VIEWS, SKY_SHARE * len(maps))
    if sky:
        progress.note(f"{skies} of {len(maps)} photographs show a plain sky: the scene is open")
    return Surfaces(cloud, maps if held else (), sky)


def contradicting(maps: Sequence[SurfaceMap], points: np.ndarray) -> float:
    """Return the share of (P, 3) points that are not within AGREE of the stereo surface, among those projected where a
    map has one; 0 if there are none."""
    known = agreeing = 0
    for found in maps:
        _, pixel, depth = visible_pixels(found.view.camera, points)
        inverse = found.planes[0][pixel[:, 1], pixel[:, 0]]
        known += np.count_nonzero(inverse)
        agreeing += np.count_nonzero(np.abs(depth * inverse - 1) < AGREE)
    return 1 - agreeing / known if known else 0.0


def _fits(views: Sequence[View], points: np.ndarray, budget: Budget) -> bool:
    """Return whether stereo takes at most BUDGET_SHARE of the time left, estimated from its first photographs."""
    rate = seconds_per_pixel(Photographs(views, points), budget)
    pixels = sum(view.camera.width * view.camera.height for view in views)
    return rate * pixels <= BUDGET_SHARE * budget.left()
