"""Compares two curves of quality against cost, at equal cost or at equal quality."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

LEVELS = 3  # number of levels at which two curves are compared: both ends and the middle of their common range


def rising(points: Sequence[Sequence[float]]) -> list[tuple[float, ...]]:
    """Return the points (x, psnr, ...) sorted by x, without those whose PSNR is not above that of all points before
    them."""
    kept: list[tuple[float, ...]] = []
    for point in sorted(map(tuple, points)):
        if not kept or point[1] > kept[-1][1]:
            kept.append(point)
    return kept


def at_psnr(points: Sequence[Sequence[float]], level: float) -> tuple[float, ...] | None:
    """Return all but the PSNR of (count, psnr, cost, ...), all > 0, at PSNR `level` on the curve `rising(points)`.

    Logarithms are interpolated linearly in the PSNR between neighbours: log x = (1 - f) log x0 + f log x1, with f =
    (level - p0) / (p1 - p0). None outside of the range of the curve; the range of a single point is its own PSNR.
    """
    curve = rising(points)
    for point in curve:
        if point[1] == level:
            return (point[0], *point[2:])
    for low, high in itertools.pairwise(curve):
        if low[1] < level < high[1]:
            part = (level - low[1]) / (high[1] - low[1])
            values = zip((low[0], *low[2:]), (high[0], *high[2:]), strict=True)
            return tuple(math.exp((1 - part) * math.log(a) + part * math.log(b)) for a, b in values)
    return None


def at_time(points: Sequence[Sequence[float]], seconds: float) -> float | None:
    """Return the PSNR after `seconds` on the curve through (seconds, psnr), linear in the logarithm of time; None
    before the first point.

    The curve is the best PSNR so far: points below an earlier PSNR are left out, and after the last point the PSNR
    stays constant.
    """
    curve = [point for point in rising(points) if point[0] > 0]
    if not curve or seconds < curve[0][0]:
        return None
    return float(np.interp(math.log(seconds), [math.log(p[0]) for p in curve], [p[1] for p in curve]))


def shared_range(curves: Sequence[Sequence[float]]) -> tuple[float, float] | None:
    """Return the intersection (low, high) of the ranges of all lists of numbers; None if it is empty."""
    low, high = max(min(c) for c in curves), min(max(c) for c in curves)
    return (low, high) if low <= high else None


def equal_psnr(a: Sequence[Sequence[float]], b: Sequence[Sequence[float]]) -> list[dict]:
    """Compare counts and frame times of two curves of (count, psnr, frame ms, core ms) at `LEVELS` PSNRs that both
    reach; [] if there are none."""
    both = shared_range([[p[1] for p in rising(curve)] for curve in (a, b)])
    if both is None:
        return []
    found = []
    for level in sorted(set(np.linspace(*both, LEVELS).tolist())):
        (count_a, ms_a, core_a), (count_b, ms_b, core_b) = at_psnr(a, level), at_psnr(b, level)
        times = {
            "ms": [ms_a, ms_b],
            "ms_ratio": ms_a / ms_b,
            "core_ms": [core_a, core_b],
            "core_ratio": core_a / core_b,
        }
        found.append({"psnr": level, "count": [count_a, count_b], **times})
    return found
