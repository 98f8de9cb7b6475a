"""The point sets that published mesh protocols score: lattices on triangles, thinned points, and means over cells."""

from __future__ import annotations

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.eval.surface_samples import corner_and_edges, morton_order
from linprim_geo.geometry.mesh import Mesh

MAX_POINTS = 60_000_000
"""Largest number of points, more than any published benchmark has. A mesh that needs more is in the wrong unit."""

THIN_START = 100_000
"""Points of the first round of `thin`; each later round processes as many as all before it."""

LATTICE_CHUNK = 4_000_000
"""Lattice nodes computed at once: some 300 MB."""


def lattice_points(mesh: Mesh, step: float) -> np.ndarray:
    """Return (P, 3) points on a lattice along two edges of each face, one per `step` squared of its area.

    The edges a-b and a-c, of lengths l and m and with an angle whose sine is s, are divided into floor(l / h) and
    floor(m / h) pieces with h = step / sqrt(s), so that a cell has an area of step^2 or slightly more. The points are
    the centres of the cells that lie in the triangle. A face too small for one cell has no points.

    Raises:
        LinprimError: there would be more than `MAX_POINTS` points.
    """
    origin, edge_b, edge_c = corner_and_edges(mesh)
    lengths = np.linalg.norm(edge_b, axis=1), np.linalg.norm(edge_c, axis=1)
    product = lengths[0] * lengths[1]
    cross = np.linalg.norm(np.cross(edge_b, edge_c), axis=1)
    check_count(0.5 * float(cross.sum()) / step**2, f"a lattice of {step:g} on the surface")
    with np.errstate(divide="ignore", invalid="ignore"):
        width = step * np.sqrt(product / cross)
        columns, rows = (np.nan_to_num(np.floor(length / width)).astype(np.int64) for length in lengths)
    nodes = columns * rows
    points = []
    ends = np.cumsum(nodes)
    start = 0
    while start < len(nodes):
        # As many faces as fit into a chunk, at least one.
        done = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, done + LATTICE_CHUNK, side="right")))
        face = np.repeat(np.arange(start, stop), nodes[start:stop])
        number = np.arange(len(face)) - np.repeat(ends[start:stop] - nodes[start:stop] - done, nodes[start:stop])
        u = (number // rows[face] + 0.5) / columns[face]
        v = (number % rows[face] + 0.5) / rows[face]
        inside = u + v < 1.0
        face, u, v = face[inside], u[inside, None], v[inside, None]
        points.append(origin[face] + u * edge_b[face] + v * edge_c[face])
        start = stop
    return np.concatenate(points)


def thin(points: np.ndarray, radius: float, seed) -> np.ndarray:
    """Return the sorted indices of the points that remain when, in random order, each remaining point removes all
    others within `radius`.

    The result is that of a loop over the shuffled points: a point remains unless an earlier remaining point is at most
    `radius` away. It is computed in rounds, each over as many points as all rounds before, so that memory does not grow
    with the density of the points.

    Args:
        points: (P, 3) finite.
        seed: of the shuffle, any argument of `numpy.random.default_rng`.
    """
    from scipy.spatial import cKDTree

    order = np.random.default_rng(seed).permutation(len(points))
    points = points - points.mean(axis=0) if len(points) else points
    kept = np.zeros(0, np.int64)
    start = 0
    while start < len(order):
        batch = order[start : start + max(THIN_START, start)]
        start += len(batch)
        if len(kept):
            tree = cKDTree(points[kept])
            curve = morton_order(points[batch])
            found = np.empty(len(batch))
            # The bound is exclusive, but a point at exactly the radius is removed too.
            bound = np.nextafter(radius, np.inf)
            found[curve] = tree.query(points[batch[curve]], distance_upper_bound=bound, workers=-1)[0]
            batch = batch[~(found <= radius)]
        kept = np.concatenate([kept, batch[_first_come(points[batch], radius)]])
    return np.sort(kept)


def _first_come(points: np.ndarray, radius: float) -> np.ndarray:
    """Return (P,) bool: which points remain when each in turn removes all later ones within `radius`.

    Computed in parallel: a point without undecided earlier neighbours remains, and removes its neighbours.
    """
    from scipy.spatial import cKDTree

    state = np.zeros(len(points), np.int8)  # 0 undecided, 1 stays, -1 removed
    if len(points) < 2:
        return state == 0
    pairs = cKDTree(points).query_pairs(radius, output_type="ndarray")
    first, later = pairs.min(axis=1), pairs.max(axis=1)
    while len(first):
        waits = np.zeros(len(points), bool)
        waits[later] = True
        stays = (state == 0) & ~waits
        state[stays] = 1
        state[later[stays[first]]] = -1
        open_ = (state[first] == 0) & (state[later] == 0)
        first, later = first[open_], later[open_]
    return state >= 0


def cell_means(points: np.ndarray, size: float) -> np.ndarray:
    """Return (Q, 3) means of the points in each occupied cell of a cubic grid of edge `size`, in cell order.

    The grid starts half a cell below the smallest coordinates.
    """
    if len(points) == 0:
        return points
    low = points.min(axis=0)
    cell = np.floor((points - low) / size + 0.5).astype(np.int64)
    count = cell.max(axis=0) + 1
    if float(count[0]) * float(count[1]) * float(count[2]) < 2**62:
        key = (cell[:, 0] * count[1] + cell[:, 1]) * count[2] + cell[:, 2]
        _, place, number = np.unique(key, return_inverse=True, return_counts=True)
    else:
        _, place, number = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    place = place.reshape(-1)
    total = [np.bincount(place, weights=points[:, axis] - low[axis]) for axis in range(3)]
    return np.stack(total, axis=1) / number[:, None] + low


def check_count(count: float, what: str) -> int:
    """Return `count` rounded up, at least 1.

    Raises:
        LinprimError: it is more than `MAX_POINTS`.
    """
    if not count <= MAX_POINTS:
        raise LinprimError(
            f"{what} has {count:.3g} points, more than {MAX_POINTS:.0e}: expected lengths in the protocol's "
            "unit, say with --meters-per-unit what the meshes' unit is"
        )
    return max(1, int(np.ceil(count)))
