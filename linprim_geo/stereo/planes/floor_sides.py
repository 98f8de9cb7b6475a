"""Find the lines along which a floor ends: the sides of the rectangle around its points, and lines within it.

The floor of a room that is not convex ends at its inner walls. Seen from above, its points cover cells of a grid, and
along a row of cells the floor ends at the last covered one. If adjacent rows end at the same place, well before the end
of the rectangle, there may be an inner wall, or a sofa.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

# Cells along the longer side of the rectangle. A cell is covered if it has at least the share COVERED of the median
# point count of cells with points.
CELLS, COVERED = 20, 0.1
# An inner side ends more than BEFORE cells before the rectangle, in at least ROWS adjacent rows, whose ends differ by
# at most SPREAD cells.
BEFORE, ROWS, SPREAD = 2, 4, 1


@dataclass(frozen=True)
class FloorSide:
    """A line along which a floor ends: from `low` to `high` (2,), in the floor's coordinates, upwards along an axis.

    `across` is the index of the other axis; along it the floor is above the line if `end` is 0, and below it if `end`
    is 1. An `inner` line is within the rectangle around the floor.
    """

    across: int
    end: int
    low: np.ndarray
    high: np.ndarray
    inner: bool = False


def outer_sides(ends: np.ndarray) -> list[FloorSide]:
    """Return the sides of the rectangle between `ends` (2, 2), the least and greatest coordinates."""
    sides = []
    for across, end in product((0, 1), (0, 1)):
        corners = ends.copy()
        corners[:, across] = ends[end, across]
        sides.append(FloorSide(across, end, corners[0], corners[1]))
    return sides


def inner_sides(ends: np.ndarray, places: np.ndarray) -> list[FloorSide]:
    """Return lines along which a floor with points at (P, 2) `places` ends within the rectangle between `ends` (2, 2),
    the least and greatest coordinates."""
    cell = float(np.diff(ends, axis=0).max()) / CELLS
    size = np.maximum(np.ceil((ends[1] - ends[0]) / cell).astype(int), 1)
    index = np.floor((places - ends[0]) / cell).astype(int)
    index = index[((index >= 0) & (index < size)).all(1)]
    count = np.zeros(size, int)
    np.add.at(count, tuple(index.T), 1)
    if not count.any():
        return []
    covered = count >= max(1.0, COVERED * float(np.median(count[count > 0])))
    found = []
    for across, end in product((0, 1), (0, 1)):
        rows = covered.T if across == 0 else covered  # each row runs along axis `across`
        rows = rows if end == 1 else rows[:, ::-1]
        length = rows.shape[1]
        last = np.where(rows.any(1), length - np.argmax(rows[:, ::-1], axis=1), 0)
        for first, after in _runs(last, length):
            place = float(np.median(last[first:after]))
            corners = np.empty((2, 2))
            corners[:, 1 - across] = ends[0, 1 - across] + cell * np.array([first, after])
            corners[:, across] = ends[0, across] + cell * (place if end == 1 else length - place)
            found.append(FloorSide(across, end, corners[0], corners[1], inner=True))
    return found


def _runs(last: np.ndarray, length: int) -> list[tuple[int, int]]:
    """Return the first, and one past the last, of each run of at least ROWS adjacent rows whose ends `last` (N,) differ
    by at most SPREAD cells and are more than BEFORE cells before `length`."""
    runs, first = [], 0
    while first < len(last):
        after = first
        while after < len(last) and np.ptp(last[first : after + 1]) <= SPREAD:
            after += 1
        if after - first >= ROWS and 0 < last[first:after].max() < length - BEFORE:
            runs.append((first, after))
        first = max(after, first + 1)
    return runs
