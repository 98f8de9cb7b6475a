"""Rasterizes triangles into a texture: which texels each covers, and where in the triangle they lie."""

from __future__ import annotations

import numpy as np

# Distance in texels up to which texels belong to a face: all that bilinear sampling of a point of the face can touch.
RING = 1.5
# Least barycentric coordinate of a texel inside a face, when overlaps of faces are sought: above rounding.
INSIDE = 1e-6
# Candidate pairs (texel, face) that are tested, and texels that are baked, at a time: some 0.4 GB.
CANDIDATES, TEXELS_PER_PASS = 2**21, 2**20


def _rasterize(corners: np.ndarray, size: int) -> np.ndarray:
    """Return (size * size,) int32 the face of each texel centre: one that contains it, else the nearest within RING,
    else -1."""
    owner = np.full(size * size, -1, dtype=np.int32)
    for texel, face, points in _candidates(corners, size, 0.0):
        inner = _weights(points, corners[face]).min(1) >= 0
        # Of equal indices the last write stays; reversed, the first face wins on an edge that two share.
        owner[texel[inner][::-1]] = face[inner][::-1]
    taken = owner >= 0
    gap = np.full(size * size, np.inf, dtype=np.float32)
    for texel, face, points in _candidates(corners, size, RING):
        free = ~taken[texel]
        texel, face = texel[free], face[free]
        distance = _nearest_in(points[free], corners[face])[1].astype(np.float32)
        near = distance <= RING
        texel, face, distance = texel[near], face[near], distance[near]
        order = np.lexsort((face, distance, texel))
        texel, face, distance = texel[order], face[order], distance[order]
        better = distance < gap[texel]
        better[1:] &= texel[1:] != texel[:-1]
        owner[texel[better]], gap[texel[better]] = face[better], distance[better]
    return owner


def _candidates(corners: np.ndarray, size: int, margin: float):
    """Yield, some at a time, the texels whose centres are in the bounding boxes of faces, widened by `margin`: texel,
    face, and centre (N, 2)."""
    low = np.maximum(np.ceil(corners.min(1) - margin - 0.5).astype(np.int64), 0)
    high = np.minimum(np.floor(corners.max(1) + margin - 0.5).astype(np.int64), size - 1)
    wide, tall = np.maximum(high - low + 1, 0).T
    for faces in _runs(wide * tall, CANDIDATES):
        each = wide[faces] * tall[faces]
        face = np.repeat(np.arange(faces.start, faces.stop), each)
        number = np.arange(len(face)) - np.repeat(np.cumsum(each) - each, each)
        x, y = low[face, 0] + number % wide[face], low[face, 1] + number // wide[face]
        yield y * size + x, face, np.stack([x, y], axis=1) + 0.5


def _runs(weights: np.ndarray, limit: int) -> list[slice]:
    """Split consecutive rows into runs that weigh at most `limit` together, or are one row."""
    ends, total = [], np.cumsum(weights)
    start = 0
    while start < len(weights):
        before = total[start - 1] if start else 0
        stop = max(int(np.searchsorted(total, before + limit, side="right")), start + 1)
        ends.append(slice(start, stop))
        start = stop
    return ends


def _cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]


def _weights(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return barycentric weights (N, 3) of points (N, 2) in triangles (N, 3, 2); all -1 in a triangle without area."""
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = _cross(ab, ac)
    safe = np.where(area != 0, area, 1.0)
    v, w = _cross(points - a, ac) / safe, _cross(ab, points - a) / safe
    weights = np.stack([1.0 - v - w, v, w], axis=1)
    weights[area == 0] = -1.0
    return weights


def _nearest_in(points: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the barycentric weights (N, 3) of the points of triangles (N, 3, 2) nearest to points (N, 2), and the
    distances (N,)."""
    weights = _weights(points, corners)
    distance = np.zeros(len(points))
    rows = np.flatnonzero(weights.min(1) < 0)
    least = np.full(len(rows), np.inf)
    for k in range(3):
        one, edge = corners[rows, k], corners[rows, (k + 1) % 3] - corners[rows, k]
        square = (edge * edge).sum(1)
        share = np.clip(((points[rows] - one) * edge).sum(1) / np.where(square > 0, square, 1.0), 0.0, 1.0)
        away = np.linalg.norm(points[rows] - one - share[:, None] * edge, axis=1)
        closer = away < least
        least[closer] = away[closer]
        turned = np.zeros((int(closer.sum()), 3))
        turned[:, k], turned[:, (k + 1) % 3] = 1.0 - share[closer], share[closer]
        weights[rows[closer]] = turned
    distance[rows] = least
    return weights, distance
