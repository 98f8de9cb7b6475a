"""Plan stereo for a given time: smaller photographs first, then fewer of them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from linprim_geo.base.budget import Budget
from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.types import View
from linprim_geo.stereo.dense.planes_on_disk import Photographs
from linprim_geo.stereo.depth_maps import halved, inverse_range, photometric_planes

# The most photographs that are timed, the share of the time budget for it, and the most pixels to which each is
# averaged down.
TIMED, TIMED_SHARE, TIMED_PIXELS = 3, 0.05, 200_000
# All of stereo takes so many times as long as its first stage, which is timed: 3.8 times on `statue_room` with two
# cores, and then the report.
WHOLE = 3.9
# Photographs are not made smaller than so many pixels along the longer side.
SMALLEST_SIDE = 240
LEAST_VIEWS = 3


@dataclass(frozen=True)
class Plan:
    """Average `downscale` by `downscale` pixels into one and process `views` photographs, all in `seconds`."""

    downscale: int
    views: int
    seconds: float


def seconds_per_pixel(photographs: Photographs, budget: Budget) -> float:
    """Estimate the time of all of stereo per pixel from the first stage of some photographs, evenly chosen from the
    capture."""
    with_sources = [k for k, sources in enumerate(photographs.pairs) if sources]
    chosen, rates = with_sources[:: max(1, len(with_sources) // TIMED)][:TIMED], []
    begin = time.monotonic()
    for k in chosen:
        images, halves = [], []
        for j in (k, *photographs.pairs[k]):
            image, half = photographs.image(j), photographs.half(j)
            while image.grey.size > TIMED_PIXELS:
                image, half = half, halved(half)
            images.append(image)
            halves.append(half)
        depths = inverse_range(photographs.cameras[k], photographs.points)
        start = time.monotonic()
        photometric_planes(images, halves, depths, photographs.noise(k), k)
        rates.append((time.monotonic() - start) / images[0].grey.size)
        if time.monotonic() - begin > TIMED_SHARE * budget.seconds:
            break
    return WHOLE * float(np.mean(rates))


def planned(views: Sequence[View], rate: float, budget: Budget) -> Plan:
    """Return the plan with the least downscale, and then the most views, that fits into the time left; `rate` is
    `seconds_per_pixel`.

    Raises:
        LinprimError: not even three small photographs fit.
    """
    cameras = [view.camera for view in views]
    pixels, longest = sum(c.width * c.height for c in cameras), max(max(c.width, c.height) for c in cameras)
    most, left = max(1, longest // SMALLEST_SIDE), budget.left()
    for downscale in range(1, most + 1):
        seconds = rate * pixels / downscale**2
        if seconds <= left:
            return Plan(downscale, len(views), seconds)
    count = int(left / seconds * len(views))
    least = min(LEAST_VIEWS, len(views))
    if count < least:
        wanted = budget.seconds - left + seconds * least / len(views)
        raise LinprimError(
            f"--time-budget is {budget.seconds:.3g} s, but the least stereo that is of any use takes {wanted:.0f} s "
            "here"
        )
    return Plan(most, count, seconds * count / len(views))
