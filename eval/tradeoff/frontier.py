"""Evaluates the sweep of a parameter: the Pareto frontier of time and error, and which slower settings are worth their
time."""

from __future__ import annotations

import math
from collections.abc import Sequence

from linprim_geo.eval.tradeoff.parameters import ERRORS, Parameter

# A slower value is worth its time if error ~ time^-r with r at least RETURN. Averaging independent samples gives 0.5,
# which is always an alternative. A relative reduction of the error below LEAST_GAIN does not count.
RETURN, LEAST_GAIN = 0.5, 0.01
RULE = (
    "A slower value is worth it if it reduces the error at least by the square root of the factor of its time, as "
    "averaging independent samples would, and by at least 1 %. Values are compared along the frontier, from the "
    "fastest on. Timings whose interquartile ranges overlap count as equal."
)


def frontier(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of the points (seconds, error) on the Pareto frontier, from the fastest on: no other point is
    lower in both. Of equal points the first counts. Points with NaN are left out."""
    order = sorted((p for p in range(len(points)) if all(map(math.isfinite, points[p]))), key=lambda p: (*points[p], p))
    kept: list[int] = []
    for k in order:
        if not kept or points[k][1] < points[kept[-1]][1]:
            kept.append(k)
    return kept


def pays(cheap: dict, expensive: dict, error: str) -> bool:
    """Return whether the step from a row to a slower one is worth its time by RULE."""
    a, b = cheap[error], expensive[error]
    if not b < (1 - LEAST_GAIN) * a:
        return False
    ratio = 1.0 if same_time(cheap, expensive) else expensive["seconds"] / cheap["seconds"]
    return b <= 0 or ratio <= 1 or math.log(a / b) >= RETURN * math.log(ratio)


def same_time(one: dict, other: dict) -> bool:
    """Return whether the interquartile ranges of two timings overlap; single timings never count as equal."""
    if min(one["rounds"], other["rounds"]) < 2:
        return False
    return one["low"] <= other["high"] and other["low"] <= one["high"]


def verdict(parameter: Parameter, rows: Sequence[dict]) -> dict:
    """Return the sentence about a parameter, and `error`, `cheapest`, `taken`, `most_accurate` (names of values).

    A row has `value`, `seconds`, `low`, `high`, `rounds` and the errors. The verdict uses the first of the parameter's
    errors that all rows have.
    """
    rows = [row for row in rows if math.isfinite(row.get("seconds", math.nan))]
    measured = [
        name for name in parameter.errors if rows and all(math.isfinite(row.get(name, math.nan)) for row in rows)
    ]
    title = parameter.title[0].upper() + parameter.title[1:]
    if not measured or len(rows) < 2:
        return {
            "sentence": f"{title}: no verdict, as fewer than two values or no common error were measured.",
            "error": None,
        }
    error = measured[0]
    on = [rows[k] for k in frontier([(row["seconds"], row[error]) for row in rows])]
    cheapest, best = on[0], on[-1]
    taken = cheapest
    for row in on[1:]:
        if pays(taken, row, error):
            taken = row
    what = ERRORS[error].title
    if taken is not cheapest:
        text = f"{title}: {_step(cheapest, taken, error)}: worth it"
        if best is not taken:
            text += f"; {_step(taken, best, error, more=True)}: not worth it"
    elif best is not cheapest:
        text = f"{title}: {_step(cheapest, best, error)}: not worth it"
    else:
        others = [row for row in rows if row is not cheapest]
        most_expensive = max(others, key=lambda row: row["seconds"])
        text = (
            f"{title}: {cheapest['value']} is the fastest, and no other removes any of the {what} "
            f"({most_expensive['value']} costs {_times(cheapest, most_expensive)}): others are not worth it"
        )
    names = {"cheapest": cheapest["value"], "taken": taken["value"], "most_accurate": best["value"]}
    return {"sentence": text + ".", "error": error, **names}


def _step(cheap: dict, expensive: dict, error: str, more: bool = False) -> str:
    a, b = cheap[error], expensive[error]
    unit = f" {ERRORS[error].unit}" if ERRORS[error].unit else ""
    less = 100 * (1 - b / a) if a > 0 else 0.0
    share = "over 99" if less > 99 else f"{less:.0f}" if less >= 9.5 else f"{less:.1g}"
    verb = "would cost" if more else "costs"
    return (
        f"{expensive['value']} {verb} {_times(cheap, expensive)} the time of {cheap['value']} and "
        f"remove{'' if more else 's'} {share} % of the "
        f"{ERRORS[error].title} ({a:.3g} to {b:.3g}{unit})"
    )


def _times(cheap: dict, expensive: dict) -> str:
    text = f"{expensive['seconds'] / cheap['seconds']:.2f}x"
    return text + (" (within the spread of the timings)" if same_time(cheap, expensive) else "")
