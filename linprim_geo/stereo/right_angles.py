"""Planes at right angles: most walls meet each other, floors and tables so.

Shading alone leaves the angle of a wall open by degrees. Planes that are nearly at right angles are made so, together:
each turns and shifts as little as what is known of it allows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from linprim_geo.stereo.plain_regions import SAME_ANGLE

# Planes are nearly at right angles if they lack no more; they are so after the last of ROUNDS if they lack RIGHT.
NEARLY, RIGHT, ROUNDS = 2 * SAME_ANGLE, np.radians(0.2), 5
# By so much a right angle counts more than what is known of planes.
WEIGHT = 1e4


def at_right_angles(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether two planes (4,), or their normals (3,), are nearly at right angles."""
    return bool(abs(first[:3] @ second[:3]) < np.sin(NEARLY))


def squared(
    planes: np.ndarray,
    information: Sequence[np.ndarray | None],
    moves: Callable[[int, np.ndarray], np.ndarray],
) -> np.ndarray:
    """Planes (K, 4) n . x = d of which those that may turn are at right angles where they nearly were.

    A plane of which no such solution is found, as right angles with some others exclude each other, stays as it is. Of
    planes that stay and are nearly parallel, the first counts.

    Args:
        information: (3, 3) about each plane's three `moves`; None for one that stays.
        moves: of a plane, by its number and what it is, (3, 4) how it changes by two turns and a shift.
    """
    free = [k for k, own in enumerate(information) if own is not None]
    lacking = np.abs(planes[:, :3] @ planes[:, :3].T)
    fixed: list[int] = []
    for k, own in enumerate(information):
        if own is None and not (lacking[k, fixed] > np.cos(NEARLY)).any():
            fixed.append(k)
    while free:
        pairs = [(i, j) for i in free for j in (*fixed, *free) if (j < i or j in fixed) and lacking[i, j] < NEARLY]
        turned = _solved(planes, free, pairs, information, moves)
        excluded = {k for i, j in pairs if abs(turned[i, :3] @ turned[j, :3]) > RIGHT for k in (i, j)}
        if not excluded:
            return turned
        free = [k for k in free if k not in excluded]
    return planes


def _solved(
    planes: np.ndarray,
    free: Sequence[int],
    pairs: Sequence[tuple[int, int]],
    information: Sequence[np.ndarray | None],
    moves: Callable[[int, np.ndarray], np.ndarray],
) -> np.ndarray:
    """The planes of which the `free` ones have moved as little as lets `pairs` be at right angles, by least squares."""
    at = {k: slice(3 * row, 3 * row + 3) for row, k in enumerate(free)}
    known, gone = np.zeros((3 * len(free), 3 * len(free))), np.zeros(3 * len(free))
    for k in free:
        own = information[k]
        assert own is not None
        known[at[k], at[k]] = own + 1e-9 * np.trace(own) * np.eye(3)
    weight, turned = WEIGHT * np.trace(known) / len(known), planes.copy()
    for _ in range(ROUNDS if pairs else 0):
        slopes = {k: moves(k, turned[k]) for k in free}
        rows = np.zeros((len(pairs), 3 * len(free)))
        for row, (i, j) in enumerate(pairs):
            rows[row, at[i]] = slopes[i][:, :3] @ turned[j, :3]
            if j in at:
                rows[row, at[j]] = slopes[j][:, :3] @ turned[i, :3]
        lack = np.array([-turned[i, :3] @ turned[j, :3] for i, j in pairs])
        step = np.linalg.solve(known + weight * rows.T @ rows, weight * rows.T @ lack - known @ gone)
        gone += step
        for k in free:
            moved = turned[k] + step[at[k]] @ slopes[k]
            turned[k] = moved / np.linalg.norm(moved[:3])
    return turned
