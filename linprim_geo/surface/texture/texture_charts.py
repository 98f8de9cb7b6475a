"""Cuts a mesh into flat charts and packs them into a square."""

from __future__ import annotations

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.mesh import Mesh, face_normals, validate_mesh
from linprim_geo.surface.finish.mesh_process import paired_edges
from linprim_geo.surface.texture.texture_raster import INSIDE, _candidates, _weights

# Free texels on each side of a chart; between two charts lie twice as many.
PADDING = 2
# Least cosine between the normal of a face and the axis along which it is projected.
LEAST_COSINE = 0.4
# Weight of the three neighbours' agreement against the cosine in the choice of a face's axis, and most rounds of
# choosing.
COHERENCE, ROUNDS = 1.0, 24


def unwrap(mesh: Mesh, size: int) -> tuple[np.ndarray, int]:
    """Flatten a mesh into the square.

    Returns:
        (F, 3, 2) float64 place of each corner in texels, x right and y down, no texel centre inside two faces; and the
        number of charts.
    Raises:
        LinprimError: an empty mesh or one that is not finite, or so many charts that they do not fit.
    """
    validate_mesh(mesh)
    if not np.isfinite(mesh.vertices).all():
        raise LinprimError(f"vertex {int(np.argmin(np.isfinite(mesh.vertices).all(1)))} of the mesh is not finite")
    points = (mesh.vertices - mesh.bounds.mean(0)) / mesh.diagonal
    normals, pairs = face_normals(mesh), np.stack(paired_edges(mesh.faces), axis=1) // 3
    axis = _facing_axes(normals, pairs)
    chart = _components(axis, pairs)
    suspects = np.ones(len(axis), dtype=bool)
    while True:
        flat = _flatten(points[mesh.faces], normals, axis, chart)
        corners = _pack(flat, chart, size)
        rows = np.flatnonzero(suspects)
        crossing = rows[_crossing(corners[rows], size)]
        if len(crossing) == 0:
            return corners, int(chart.max()) + 1
        label, changed = _split(points[mesh.faces].mean(1), axis, chart, crossing)
        chart = _components(label, pairs)
        suspects = changed


def _facing_axes(normals: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return (F,) the axis of each face, 0 to 2 for +x, +y, +z and 3 to 5 for the opposite ones, preferably that of its
    neighbours."""
    cosine = np.concatenate([normals, -normals], axis=1)
    # The best of six is at least 1 / sqrt(3), so a face with a normal always has a choice.
    allowed = (cosine >= LEAST_COSINE) | ~np.any(normals, axis=1)[:, None]
    label = np.argmax(cosine, axis=1)
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    for _ in range(ROUNDS):
        votes = np.bincount(ends[:, 0] * 6 + label[ends[:, 1]], minlength=6 * len(label)).reshape(-1, 6)
        chosen = np.argmax(np.where(allowed, cosine + COHERENCE / 3.0 * votes, -np.inf), axis=1)
        if np.array_equal(chosen, label):
            break
        label = chosen
    return label


def _components(label: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return (F,) the number of the chart of each face: neighbours with the same label share a chart."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    one, other = pairs[label[pairs[:, 0]] == label[pairs[:, 1]]].T
    graph = coo_matrix((np.ones(len(one), dtype=np.int8), (one, other)), shape=(len(label), len(label)))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def _split(
    centers: np.ndarray, axis: np.ndarray, chart: np.ndarray, crossing: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return labels that separate the `crossing` faces, whose projections overlap, from their charts; and which faces
    are in such a chart.

    A chart of crossing faces only is cut in two at the median height of its faces.
    """
    count = int(chart.max()) + 1
    inside = np.zeros(len(chart), dtype=bool)
    inside[crossing] = True
    number = np.bincount(chart[crossing], minlength=count)
    whole = (number == np.bincount(chart, minlength=count))[chart]
    label = 2 * chart + (inside & ~whole)
    rows = np.flatnonzero(whole)
    if len(rows):
        height = np.take_along_axis(centers[rows], (axis[rows] % 3)[:, None], axis=1)[:, 0]
        order = np.lexsort((height, chart[rows]))
        _, first, faces = np.unique(chart[rows][order], return_index=True, return_counts=True)
        rank = np.arange(len(rows)) - np.repeat(first, faces)
        label[rows[order]] += rank >= np.repeat(faces // 2, faces)
    return label, (number > 0)[chart]


def _flatten(corners: np.ndarray, normals: np.ndarray, axis: np.ndarray, chart: np.ndarray) -> np.ndarray:
    """Return (F, 3, 2) corners of each face in the plane of its chart, rotated to lie in a small box that starts at 0.

    The plane is orthogonal to the mean normal of the chart if all its faces look along that, else to its axis.
    """
    count = int(chart.max()) + 1
    edge, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross = np.cross(edge, other)
    mean = np.stack([np.bincount(chart, cross[:, k], count) for k in range(3)], axis=1)
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    mean = np.divide(mean, length, out=np.zeros_like(mean), where=length > 0)
    least = np.ones(count)
    cosine = np.einsum("fk,fk->f", normals, mean[chart])
    np.minimum.at(least, chart[normals.any(1)], cosine[normals.any(1)])
    first = np.zeros(count, dtype=np.int64)
    first[chart[::-1]] = np.arange(len(chart))[::-1]
    along = np.concatenate([np.eye(3), -np.eye(3)])[axis[first]]
    direction = np.where(((least >= LEAST_COSINE) & (length[:, 0] > 0))[:, None], mean, along)
    helper = np.eye(3)[np.argmin(np.abs(direction), axis=1)]
    right = np.cross(helper, direction)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(direction, right)
    flat = np.stack([np.einsum("fkc,fc->fk", corners, side[chart]) for side in (right, down)], axis=2)

    # Rotate to the principal axes of the corners, if that box is smaller.
    owner = np.repeat(chart, 3)
    size = np.maximum(np.bincount(owner, minlength=count), 1)
    x, y = (flat[..., k].ravel() for k in range(2))
    x = x - (np.bincount(owner, x, count) / size)[owner]
    y = y - (np.bincount(owner, y, count) / size)[owner]
    xx, yy, xy = (np.bincount(owner, value, count) for value in (x * x, y * y, x * y))
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    c, s = np.cos(angle)[owner], np.sin(angle)[owner]
    turned = np.stack([c * x + s * y, c * y - s * x], axis=1)
    plain = np.stack([x, y], axis=1)
    box, box_turned = _boxes(plain, owner, count), _boxes(turned, owner, count)
    better = np.prod(box_turned[1] - box_turned[0], axis=1) < np.prod(box[1] - box[0], axis=1)
    flat = np.where(better[owner, None], turned, plain)
    low, high = _boxes(flat, owner, count)
    flat = flat - low[owner]
    upright = (high - low)[:, 1] > (high - low)[:, 0]
    flat = np.where(upright[owner, None], flat[:, ::-1], flat)
    return flat.reshape(-1, 3, 2)


def _boxes(points: np.ndarray, owner: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, owner, points)
    np.maximum.at(high, owner, points)
    return low, high


def _pack(flat: np.ndarray, chart: np.ndarray, size: int) -> np.ndarray:
    """Pack charts on shelves at the largest scale at which they fit. Return (F, 3, 2) corners in texels.

    Raises:
        LinprimError: they do not fit at any scale.
    """
    count = int(chart.max()) + 1
    extent = _boxes(flat.reshape(-1, 2), np.repeat(chart, 3), count)[1]
    low, place = 0.0, _shelves(np.zeros_like(extent), size)
    if place is None:
        raise LinprimError(
            f"the {count} charts of {len(chart)} faces do not fit into a texture of {size}x{size} texels: "
            "wanted a larger --texture, or fewer faces by --target-faces"
        )
    area = float(np.prod(extent, axis=1).sum())
    high = size / np.sqrt(area) if area > 0 else float(size)
    for _ in range(24):
        middle = 0.5 * (low + high)
        trial = _shelves(extent * middle, size)
        if trial is None:
            high = middle
        else:
            low, place = middle, trial
    return flat * low + place[chart][:, None, :] + (PADDING + 0.5)


def _shelves(extent: np.ndarray, size: int) -> np.ndarray | None:
    """Return (C, 2) whole texels at which padded boxes start, tallest first from left to right; None if they do not
    fit."""
    boxes = np.ceil(extent).astype(np.int64) + 1 + 2 * PADDING
    if boxes.max() > size or boxes.prod(1).sum() > size**2:
        return None
    order = np.lexsort((-boxes[:, 0], -boxes[:, 1]))
    place = np.empty((len(boxes), 2), dtype=np.int64)
    x = y = shelf = 0
    for k, (width, height) in zip(order.tolist(), boxes[order].tolist(), strict=True):
        if x + width > size:
            x, y, shelf = 0, y + shelf, 0
        shelf = max(shelf, height)
        if y + height > size:
            return None
        place[k] = x, y
        x += width
    return place


# --- texels ----------------------------------------------------------------------------------------------


def _crossing(corners: np.ndarray, size: int) -> np.ndarray:
    """Return the faces that contain a texel centre which lies inside another face, too."""
    owner = np.full(size * size, -1, dtype=np.int64)
    found = []
    for texel, face, points in _candidates(corners, size, 0.0):
        inner = _weights(points, corners[face]).min(1) > INSIDE
        texel, face = texel[inner], face[inner]
        before = owner[texel]
        owner[texel] = face
        # A face that is not the last one written to a texel in this run overlaps another one there.
        found += [
            face[before >= 0],
            before[before >= 0],
            face[owner[texel] != face],
            owner[texel][owner[texel] != face],
        ]
    return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *found]))
