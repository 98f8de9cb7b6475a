"""Turn planes to right angles: most walls, floors and tables meet at right angles.

Shading alone leaves the angle of a wall open by degrees. If the better known planes of a room have a frame, three
orthogonal directions along which most of them lie, other planes are turned to it. Without a frame, planes that are
nearly at right angles are turned to right angles together. Each turns and shifts as little as its information allows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from linprim_geo.stereo.planes.plain_regions import SAME_ANGLE

# Two planes are nearly at right angles if they differ from it by less than NEARLY (radians), and count as at right
# angles after the last of ROUNDS iterations if they differ by at most RIGHT.
NEARLY, RIGHT, ROUNDS = 2 * SAME_ANGLE, np.radians(0.2), 5
# The angle of a wall in radians that shading leaves open: nine in ten planes of single regions err by no more.
MOST_ANGLE_ERROR = np.radians(20)
# The weight of a right angle, relative to the mean information about planes.
WEIGHT = 1e4


def at_right_angles(first: np.ndarray, second: np.ndarray) -> bool:
    """Return whether two planes (4,), or their normals (3,), are nearly at right angles."""
    return bool(abs(first[:3] @ second[:3]) < np.sin(NEARLY))


def frame_of(normals: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray | None:
    """Return the frame of a room (3, 3): three orthogonal unit vectors along which most of (K, 3) unit normals lie,
    which count by their (K,) `weight`, or 1. None if no two normals are nearly at right angles."""
    weight = np.ones(len(normals)) if weight is None else weight
    found, most = None, 0.0
    for first in normals:
        for second in normals:
            if at_right_angles(first, second):
                across = second - first * (first @ second)
                across /= np.linalg.norm(across)
                axes = np.stack([first, across, np.cross(first, across)])
                # Tukey's weight: normals that are not nearly along an axis count nothing.
                along = weight @ np.maximum(0, 1 - (angles_to(axes, normals) / NEARLY) ** 2) ** 2
                if along > most:
                    found, most = axes, along
    return None if found is None else _middle(found, normals, weight)


def angles_to(axes: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return (K,) angles between (K, 3) unit normals and the nearest of the (3, 3) axes, regardless of sign."""
    return np.arccos(np.minimum(np.abs(normals @ axes.T).max(1), 1))


def off_frame(axes: np.ndarray | None, normals: np.ndarray) -> np.ndarray:
    """Return the (K,) angles of (K, 3) unit normals to the nearest of the (3, 3) axes if they are nearly along it, and
    otherwise to the nearest right angle with one, as those of roofs have; infinite without axes."""
    if axes is None:
        return np.full(len(normals), np.inf)
    angle, lacking = angles_to(axes, normals), np.arcsin(np.minimum(np.abs(normals @ axes.T).min(1), 1))
    return np.where(angle < NEARLY, angle, lacking)


def _middle(axes: np.ndarray, normals: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Rotate the axes to the least sum, weighted by (K,) `weight`, of angles to the normals that are nearly along
    them."""
    for _ in range(10 * ROUNDS):
        angle = angles_to(axes, normals)
        near = np.flatnonzero(angle < NEARLY)
        along = normals[near] @ axes.T
        nearest = np.abs(along).argmax(1)
        sign = np.sign(along[np.arange(len(near)), nearest])
        towards = np.zeros((3, 3))
        share = weight[near] / weight.sum() * sign / np.maximum(angle[near], RIGHT)
        np.add.at(towards, nearest, share[:, None] * normals[near])
        # An axis without normals stays where the others put it.
        left, _, right = np.linalg.svd(towards + 1e-3 * axes)
        axes = left @ right
    return axes


def orthogonalised(
    planes: np.ndarray,
    information: Sequence[np.ndarray | None],
    moves: Callable[[int, np.ndarray], np.ndarray],
    frame: np.ndarray | None = None,
) -> np.ndarray:
    """Return planes (K, 4) n . x = d, of which the movable ones are turned to right angles where they nearly were.

    With a `frame`, movable planes that may be along an axis are turned to it. The others, and all without a frame, are
    turned to right angles with fixed planes and with each other; those without a solution, as their right angles
    exclude each other, are not changed. Of fixed planes that are nearly parallel only one counts: the one nearest to an
    axis, or the first.

    Args:
        information: (3, 3) for the three `moves` of each plane; None for a fixed plane.
        moves: returns the (3, 4) derivatives of a plane, given its number and value, by two turns and a shift.
        frame: (3, 3) frame of the fixed planes (`frame_of`).
    """
    free, staying = ([k for k, own in enumerate(information) if (own is None) == stays] for stays in (False, True))
    if frame is not None:
        angle = angles_to(frame, planes[:, :3])
        staying.sort(key=lambda k: angle[k])
        framed = [k for k in free if angle[k] < MOST_ANGLE_ERROR]
        planes = _along(planes, frame, framed, information, moves) if framed else planes
        free = [k for k in free if k not in framed]
    lacking = np.abs(planes[:, :3] @ planes[:, :3].T)
    fixed: list[int] = []
    for k in staying:
        if not (lacking[k, fixed] > np.cos(NEARLY)).any():
            fixed.append(k)
    while free:
        pairs = [(i, j) for i in free for j in (*fixed, *free) if (j < i or j in fixed) and lacking[i, j] < NEARLY]
        turned = _solved(planes, free, pairs, information, moves)
        excluded = {k for i, j in pairs if abs(turned[i, :3] @ turned[j, :3]) > RIGHT for k in (i, j)}
        if not excluded:
            return turned
        free = [k for k in free if k not in excluded]
    return planes


def _along(
    planes: np.ndarray,
    frame: np.ndarray,
    framed: Sequence[int],
    information: Sequence[np.ndarray | None],
    moves: Callable[[int, np.ndarray], np.ndarray],
) -> np.ndarray:
    """Return the planes with the `framed` ones turned as little as possible to the nearest axis of a frame."""
    axes = np.column_stack([frame, np.zeros(3)])
    across = np.abs(planes[:, :3] @ frame.T)
    pairs = [(k, len(planes) + j) for k in framed for j in range(3) if j != across[k].argmax()]
    return _solved(np.concatenate([planes, axes]), framed, pairs, information, moves)[: len(planes)]


def _solved(
    planes: np.ndarray,
    free: Sequence[int],
    pairs: Sequence[tuple[int, int]],
    information: Sequence[np.ndarray | None],
    moves: Callable[[int, np.ndarray], np.ndarray],
) -> np.ndarray:
    """Return the planes with the `free` ones moved as little as possible, by least squares, so that `pairs` are at
    right angles."""
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
