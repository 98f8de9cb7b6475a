"""Fits planes to surface points, which cut back the primitives around them.

Surface points are where the transmittance of training rays falls to a level (`level_points`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from linprim_geo.base.kinds import KINDS
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.primitives import Primitives
from linprim_geo.kernels import surface_ops

NEIGHBOURHOOD = 1.5
"""Factor by which a primitive is enlarged to collect the points for its planes, so that planes of neighbours agree."""

PLANES = 8
"""Most planes that cut one primitive: an octahedron that is seen from all around has this many faces."""

SAME_PLANE = np.cos(np.radians(35.0))
"""Least cosine (35 degrees) between a point's normal and the direction of a plane that it belongs to. The angle is less
than half of the right angle between sides of a body, and more than the unevenness of one side."""

DIRECTION_CELLS = 3
"""Cells per unit of a normal's coordinates, 19 degrees wide. The search for a direction starts in the fullest cell."""

SAME_DIRECTION = np.cos(np.radians(20.0))
"""Window of the mean shift that finds a direction, as a cosine (20 degrees): less than half of the angle between two
planes."""

LEAST_POINTS, LEAST_SHARE = 6, 0.06
"""Fewest points of a plane, and their least share of the points around its primitive."""

ROUNDS = 4
"""Rounds of reweighted fits, and of mean shift; in a fit, the normal moves by less than its own uncertainty after
three."""

LEAST_SHARE_OF_PIXEL = 0.1
"""Distance, as a share of a pixel's footprint, by which the surface may move to remove slivers: what the robust mean of
many pixels still resolves."""


@dataclass(frozen=True)
class LevelPoints:
    """(P, 3) surface points, at a level of transmittance, their (P, 3) unit normals towards the cameras, and the median
    footprint of a pixel there."""

    position: np.ndarray
    normal: np.ndarray
    footprint: float

    @property
    def noise(self) -> float:
        """Length below which the views resolve nothing."""
        return LEAST_SHARE_OF_PIXEL * self.footprint


def level_points(
    depths: Iterable[np.ndarray], cameras: list[Camera], wanted: int, hits: int | None = None
) -> LevelPoints:
    """Return points of about `wanted` pixels of all depth maps, in a regular pattern that shifts from view to view.

    Normals are those of the surface through a pixel's four neighbours. Pixels at the border of the image, and those
    with a neighbour without depth, give no point.

    `hits`: the number of pixels with a depth, if it is known already.
    """
    hits = sum(int((depth > 0).sum()) for depth in depths) if hits is None else hits
    stride = max(1, round(np.sqrt(hits / max(wanted, 1))))
    positions, normals, footprints = [], [], []
    for number, (depth, camera) in enumerate(zip(depths, cameras, strict=True)):
        there = depth > 0
        if min(depth.shape) < 3 or not there.any():
            continue
        footprints.append(np.median(depth[there]) / np.sqrt(camera.fx * camera.fy))
        inner = there[1:-1, 1:-1] & there[1:-1, 2:] & there[1:-1, :-2] & there[2:, 1:-1] & there[:-2, 1:-1]
        pattern = np.zeros_like(inner)
        pattern[number % stride :: stride, number // stride % stride :: stride] = True
        row, column = np.nonzero(inner & pattern)
        row, column = row + 1, column + 1
        point = _local(camera, depth, row, column)
        normal = np.cross(
            _local(camera, depth, row, column + 1) - _local(camera, depth, row, column - 1),
            _local(camera, depth, row + 1, column) - _local(camera, depth, row - 1, column),
        )
        length = np.linalg.norm(normal, axis=1)
        point, normal = point[length > 0], normal[length > 0] / length[length > 0, None]
        normal *= np.where(np.einsum("ij,ij->i", normal, point) > 0, -1.0, 1.0)[:, None]
        positions.append((point - camera.world_to_camera[:3, 3]) @ camera.rotation)
        normals.append(normal @ camera.rotation)
    if not positions:
        return LevelPoints(np.zeros((0, 3)), np.zeros((0, 3)), 0.0)
    return LevelPoints(np.concatenate(positions), np.concatenate(normals), float(np.median(footprints)))


def _local(camera: Camera, depth: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Return (P, 3) points in the camera's axes that (P,) pixels show."""
    z = depth[row, column].astype(np.float64)
    x, y = (column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy
    return np.stack([x * z, y * z, z], axis=1)


@dataclass(frozen=True)
class Planes:
    """Fitted planes { x : normal x = offset } with the body on the negative side; the `row` of each plane's primitive
    and its `slot`, its number among that primitive's planes; and `cuts` (K, PLANES) bool: which planes of its primitive
    bound the body together with this one."""

    row: np.ndarray
    slot: np.ndarray
    normal: np.ndarray
    offset: np.ndarray
    cuts: np.ndarray


def fit_planes(primitives: Primitives, points: LevelPoints) -> tuple[Planes, np.ndarray]:
    """Fit at most PLANES planes to the points around each primitive. Return them and (N,) bool: whether a primitive
    contains LEAST_POINTS points; one that does not gets no plane.

    Points are clustered by their normals: the strongest direction first, by mean shift, then the next one among the
    remaining points. Each cluster gets a least-squares plane, reweighted with Cauchy weights by its own spread. Two
    planes of a primitive bound the body together if the points of the one lie behind the other (a convex edge), else
    each on its own (a concave one).
    """
    center, position = primitives.center.astype(np.float64), np.ascontiguousarray(points.position)
    total, point = surface_ops.points_within(center, *face_planes(primitives), position, NEIGHBOURHOOD, LEAST_POINTS)
    count, position, normal = len(primitives), position[point], points.normal[point]
    owner = np.repeat(np.arange(count), total)
    slot = np.full(len(owner), -1)
    for k in range(PLANES):
        left = np.flatnonzero(slot < 0)
        direction = _strongest_direction(owner[left], normal[left], count)
        near = left[np.einsum("ij,ij->i", normal[left], direction[owner[left]]) > SAME_PLANE]
        size = np.bincount(owner[near], minlength=count)
        enough = (size >= LEAST_POINTS) & (size >= LEAST_SHARE * total)
        slot[near[enough[owner[near]]]] = k
    used = np.flatnonzero(slot >= 0)
    key = owner[used] * PLANES + slot[used]
    order = used[np.argsort(key, kind="stable")]
    keys, group = np.unique(owner[order] * PLANES + slot[order], return_inverse=True)
    across, offset, spread = _robust_planes(position[order], normal[order], group, len(keys))
    row, number = keys // PLANES, keys % PLANES
    table = np.full((count, PLANES), -1)
    table[row, number] = np.arange(len(keys))
    cuts = np.zeros((len(keys), PLANES), dtype=bool)
    for k in range(PLANES):
        other = table[row, k]
        signed = np.einsum("ij,ij->i", position[order], across[other[group]]) - offset[other[group]]
        cuts[:, k] = (other >= 0) & (_medians(signed, group, len(keys)) < 0)
    cuts[np.arange(len(keys)), number] = True
    # Points that scatter by more than a pixel make no plane.
    flat = np.append(spread <= points.footprint, False)
    cuts &= flat[table[row]]
    return Planes(row, number, across, offset, cuts), total > 0


def face_planes(primitives: Primitives) -> tuple[np.ndarray, np.ndarray]:
    """Return (N, F, 3) outward unit normals of the faces and (N, F) their distances from the centre."""
    local = primitives.vertices - primitives.center.astype(np.float64)[:, None]
    a, b, c = (local[:, KINDS[primitives.kind].faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), np.finfo(np.float64).tiny)
    return normal, np.maximum(np.einsum("nfi,nfi->nf", normal, a), np.finfo(np.float64).tiny)


def _sums(values: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    """Return (count, ...) sums of (M, ...) values by group."""
    flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
    out = [np.bincount(group, weights=column, minlength=count).astype(np.float64) for column in flat.T]
    return np.stack(out, axis=-1).reshape((count,) + values.shape[1:])


def _medians(values: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    """Return (count,) lower medians by group; every group has a value."""
    from scipy.sparse import coo_matrix

    # By value, then by group: the conversion to rows keeps the order within each, and is faster than sorting again.
    order = np.argsort(values)
    order = coo_matrix((order, (group[order], np.arange(len(order)))), shape=(count, len(order))).tocsr().data
    size = np.bincount(group, minlength=count)
    return values[order[np.cumsum(size) - size + (size - 1) // 2]]


def _strongest_direction(group: np.ndarray, normal: np.ndarray, count: int) -> np.ndarray:
    """Return the (count, 3) direction in which most normals of each group point: the mean of the fullest cell of 1 /
    DIRECTION_CELLS, refined by mean shift. Zero for a group without normals."""
    side = 2 * DIRECTION_CELLS + 1
    x, y, z = np.rint(normal * DIRECTION_CELLS).astype(np.int64).T + DIRECTION_CELLS
    cells, cell, size = np.unique(((group * side + x) * side + y) * side + z, return_inverse=True, return_counts=True)
    of_cell = cells // side**3
    order = np.lexsort((-cells, size, of_cell))
    fullest = np.full(count, -1)
    fullest[of_cell[order]] = order
    chosen = cell == fullest[group]
    direction = np.zeros((count, 3))
    for _ in range(ROUNDS):
        mean = _sums(normal[chosen], group[chosen], count)
        length = np.linalg.norm(mean, axis=1, keepdims=True)
        direction = np.where(length > 0, mean / np.maximum(length, np.finfo(np.float64).tiny), direction)
        chosen = np.einsum("ij,ij->i", normal, direction[group]) > SAME_DIRECTION
    return direction


def _robust_planes(position: np.ndarray, normal: np.ndarray, group: np.ndarray, count: int):
    """Fit planes by group. Return (count, 3) normals, (count,) offsets and (count,) spreads (1.4826 median |residual|).

    The normal is the flattest principal direction of the points if it holds less than a tenth of the variance of the
    next one, else the mean of the points' normals.
    """
    tiny = np.finfo(np.float64).tiny
    across = _sums(normal, group, count)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), tiny)
    origin = _sums(position, group, count) / np.bincount(group, minlength=count)[:, None]
    weight = np.ones(len(group))
    for step in range(ROUNDS + 1):
        away = np.einsum("ij,ij->i", position - origin[group], across[group])
        middle = _medians(away, group, count)
        spread = 1.4826 * _medians(np.abs(away - middle[group]), group, count)
        if step == ROUNDS:
            break
        scaled = (away - middle[group]) / np.maximum(2 * spread[group], tiny)
        weight = 1 / (1 + np.minimum(np.abs(scaled), 1e6) ** 2)
        mass = _sums(weight, group, count)
        origin = _sums(weight[:, None] * position, group, count) / mass[:, None]
        centered = position - origin[group]
        moment = _sums((weight[:, None] * centered)[:, :, None] * centered[:, None, :], group, count)
        variance, axes = np.linalg.eigh(moment)
        flattest = axes[:, :, 0] * np.where(np.einsum("ij,ij->i", axes[:, :, 0], across) < 0, -1.0, 1.0)[:, None]
        told = variance[:, 0] < 0.1 * variance[:, 1]
        across = np.where(told[:, None], flattest, across)
    return across, np.einsum("ij,ij->i", origin, across) + middle, spread
